"""A network and a loss of another package: registered by entry points, trained for a batch, and used to detect."""

import sys
from pathlib import Path

import pytest
import torch

from femoreg_torch.detect import detect, load_network
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm
from training.commands import train

MODULE = """
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from models.protocols import Prediction


class Shallow(nn.Module):
    def __init__(self, classes, landmarks, width):
        super().__init__()
        self.features = nn.Conv2d(1, width, 5, stride=2, padding=2)
        self.segmentation = nn.Conv2d(width, classes, 1)
        self.heatmaps = nn.Conv2d(width, landmarks, 1)
        self.absence = nn.Parameter(torch.zeros(landmarks))

    def forward(self, images):
        features = self.features(images).relu()
        absence = self.absence.expand(len(images), -1)
        return Prediction(self.segmentation(features), self.heatmaps(features), absence)


@dataclass(frozen=True)
class ShallowSettings:
    classes: int
    landmarks: int
    width: int = 4

    def build(self):
        return Shallow(self.classes, self.landmarks, self.width)


@dataclass(frozen=True)
class FocalLoss:
    gamma: float
    sigma_px: float = 2.0

    def __call__(self, prediction, labels, pixels, visible):
        entropy = F.cross_entropy(prediction.segmentation, labels.long(), reduction="none")
        focal = ((1 - (-entropy).exp()) ** self.gamma * entropy).mean()
        presence = F.binary_cross_entropy_with_logits(-prediction.absence, visible.float())
        return {"loss": focal + presence + 0 * prediction.heatmaps.mean(), "focal": focal, "presence": presence}
"""

ENTRY_POINTS = """
[femoreg_torch.networks]
shallow = mine:ShallowSettings

[femoreg_torch.losses]
focal = mine:FocalLoss
"""

SETTINGS = """
cohort: {patient_seeds: [], validation_seeds: [], case_variants: 1, views: 2}
network: {kind: shallow, width: 6}
loss: {kind: focal, gamma: 2.0}
optimisation: {epochs: 1, batches_per_epoch: 1, batch_size: 2}
workers: 0
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package `mine`, as far as Python can tell."""
    site = tmp_path / "site"
    (site / "mine-1.0.dist-info").mkdir(parents=True)
    (site / "mine-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n", encoding="utf-8"
    )
    (site / "mine-1.0.dist-info" / "entry_points.txt").write_text(ENTRY_POINTS, encoding="utf-8")
    (site / "mine.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "mine", raising=False)


@pytest.mark.usefixtures("mine")
def test_a_network_and_a_loss_of_ones_own(case: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(SETTINGS, encoding="utf-8")
    train(str(tmp_path / "mine.yaml"), out=tmp_path / "run", cases=[case])
    network = load_network(tmp_path / "run" / "hip14.safetensors")
    assert type(network.module).__name__ == "Shallow"
    assert network.module.features.out_channels == 6
    assert network.sigma_px == 2.0
    camera = load_carm("cios_fusion").camera.downsampled(8)
    found = detect(network, torch.rand(camera.shape, generator=torch.Generator().manual_seed(1)), camera)
    assert found.segmentation.shape == (7, 96, 96)
    assert len(found.visible) == 14
    columns = (
        (tmp_path / "run" / "csv" / "version_0" / "metrics.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    )
    assert {"train/loss", "train/focal", "train/presence"} <= set(columns)


def test_without_the_package_its_kind_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(SETTINGS, encoding="utf-8")
    with pytest.raises(InputError, match=r"mine\.yaml, network: unknown kind 'shallow'.*multitask_unet"):
        train(str(tmp_path / "mine.yaml"), out=tmp_path / "run")
