"""The measurement against a network that says what was planted, and intervals against hand-made readings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from femoreg_torch.detect.grid import NETWORK_PIXEL_MM
from femoreg_torch.detect.looks import PLAIN
from femoreg_torch.geometry import load_carm, project_points, transform_points
from models.losses import landmark_target
from models.unet import Prediction
from training.augmentation import Batch, inside
from training.measure import LabelledImage, Reading, images_of_batches, read_images, summarise

CAMERA = load_carm("cios_fusion").camera.downsampled(8)


class Planted(nn.Module):
    """Answers image after image with what was planted, and with a shrug when shown one upside down or inverted."""

    def __init__(self, pixels: Tensor, visible: Tensor, labels: Tensor) -> None:
        super().__init__()
        logits = landmark_target(pixels, visible, (96, 96), 1.5).clamp_min(1e-12).log()
        segmentation = nn.functional.one_hot(labels.long(), 7).movedim(-1, 1).float() * 20
        self.heatmaps, self.absence = logits[..., :-1].view(-1, 14, 96, 96), logits[..., -1]
        self.segmentation = segmentation

    def forward(self, images: Tensor) -> Prediction:
        n = int(images[0, 0, 0, 0] < images[0, 0, 0, -1])  # which of two images
        upright = images[0, 0, :20].mean() > images[0, 0, -20:].mean()
        absence = self.absence[n] if upright else self.absence[n] + 50
        return Prediction(self.segmentation[n : n + 1], self.heatmaps[n : n + 1], absence[None])


def images() -> Tensor:
    """Two images, bright above, that rise to the left and to the right."""
    row, column = torch.meshgrid(torch.arange(192.0), torch.arange(192.0), indexing="ij")
    return torch.stack([-3 * row - column, -3 * row + column])[:, None]


def test_errors_misses_and_false_finds_are_counted() -> None:
    pixels = torch.full((2, 14, 2), 40.0)
    visible = torch.ones(2, 14, dtype=torch.bool)
    visible[:, 0] = False
    labels = torch.zeros(2, 96, 96, dtype=torch.uint8)
    labels[:, :10, :10] = 5
    shifted = pixels + torch.tensor([2.0, 0.0])
    found = visible.clone()
    found[0, 0] = True  # one of the two that are not there
    found[:, 13] = False  # two of the 26 that are
    network = Planted(shifted, found, labels.roll(5, 1))
    batch = Batch(images(), labels, pixels, visible)
    accuracy = summarise(read_images(network, images_of_batches([batch], CAMERA, "one"), PLAIN))
    value = {name: measure.value for name, measure in accuracy.measures.items()}
    for name in ("median_mm", "mean_mm", "p90_mm"):
        assert value[name] == pytest.approx(2 * 2 * NETWORK_PIXEL_MM, abs=0.05)
    assert value["recall"] == pytest.approx(24 / 26)
    assert value["false_positives"] == 0.5
    assert value["gross"] == 0
    assert value["dice_5"] == pytest.approx(0.5)
    assert np.isnan(value["pose_fair"])
    assert accuracy.landmarks[3] == pytest.approx((6.208, 6.208, 1.0, 2), abs=0.05)
    assert accuracy.landmarks[13][2:] == (0, 2)


def test_poses_are_judged() -> None:
    points = torch.tensor(
        [[s * x, y, z] for x, y, z in [[90.0, -10, -80], [75, 15, -25], [48, 10, -120]] for s in (1, -1)]
        + [
            [s * x, y, z]
            for x, y, z in [[30.0, -10, -112], [4, -45, -108], [4, -20, -120], [85, -75, -45]]
            for s in (1, -1)
        ]
    ).double()
    truth = torch.tensor([[1.0, 0, 0, 20], [0, 0, -1, -60], [0, 1, 0, 760], [0, 0, 0, 1]]).double()
    pixels = project_points(CAMERA, transform_points(truth, points))
    visible = inside(pixels, CAMERA.shape)
    network = Planted(((pixels - 0.5) / 2).float().expand(2, -1, -1), visible.expand(2, -1), torch.zeros(2, 96, 96))
    image = LabelledImage("one", images()[0, 0], CAMERA, pixels, torch.zeros(96, 96), visible, points, truth)
    moved = truth.clone()
    moved[2, 3] += 70
    readings = read_images(network, [image, replace(image, camera_from_lps=moved)], PLAIN)
    assert readings[0].pose_error[0] < 1
    assert readings[1].pose_error[2] == pytest.approx(70, abs=5)
    value = summarise(readings).measures
    assert (value["pose_fair"].value, value["pose_coarse"].value, value["pose_refused"].value) == (0.5, 1.0, 0.0)
    hidden = replace(image, visible=visible & (torch.arange(14) < 5))
    assert not read_images(network, [hidden], PLAIN)[0].asked


def reading(patient: str, error_mm: float) -> Reading:
    yes = np.ones(14, dtype=bool)
    nothing = np.full(3, np.nan)
    return Reading(patient, np.full(14, error_mm), yes, yes, np.ones(14), np.ones((6, 2)), False, False, nothing)


def test_the_interval_is_over_patients_not_over_images() -> None:
    """Two patients, a thousand images: half of all redraws hold one patient only."""
    accuracy = summarise([reading("a", 1.0)] * 500 + [reading("b", 3.0)] * 500)
    mean = accuracy.measures["mean_mm"]
    assert (mean.value, mean.low, mean.high) == (2.0, 1.0, 3.0)
    assert (accuracy.images, accuracy.patients) == (1000, 2)
    alone = summarise([reading("a", 1.0)] * 10).measures["mean_mm"]
    assert alone.low == alone.high == 1.0
