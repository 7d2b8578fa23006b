"""Learning on a CPU in seconds: one batch by heart, and one run from a case folder to exported weights."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from femoreg_torch.volume import HIP_LANDMARKS, Volume, axis_aligned, write_landmarks, write_volume
from models.build import make_network
from models.losses import multi_task_loss
from models.unet import UNet, UNetConfig
from models.weights import save_weights
from training.commands import train
from training.data import ViewBatches
from training.devices import read_devices
from training.run import _begin_with
from training.settings import read_settings

SETTINGS = """
cohort:
  patient_seeds: []
  validation_seeds: []
  case_variants: 2
  views: 3
network:
  channels: [8, 12, 16]
  convolutions: [1, 1, 1]
optimisation:
  epochs: 1
  batches_per_epoch: 2
  batch_size: 2
workers: 0
"""


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two hip bones, a sacrum and two femora as boxes of bone in a block of muscle."""
    folder = tmp_path_factory.mktemp("case")
    ct, labels = torch.full((50, 40, 70), -1000.0), torch.zeros((50, 40, 70), dtype=torch.uint8)
    ct[2:-2, 2:-2, 2:-2] = 40.0
    boxes = {1: (44, 62, 15, 45), 2: (8, 26, 15, 45), 4: (29, 41, 30, 48), 5: (50, 60, 3, 13), 6: (10, 20, 3, 13)}
    for label, (x0, x1, z0, z1) in boxes.items():
        ct[z0:z1, 12:28, x0:x1], labels[z0:z1, 12:28, x0:x1] = 700.0, label
    affine = axis_aligned((4.0, 4.0, 4.0), (-140.0, -80.0, -100.0))
    write_volume(folder / "ct.nii.gz", Volume(ct, affine))
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    sides = {"l": 1.0, "r": -1.0}
    points = {
        name: torch.tensor([sides[name[-1]] * (20.0 + 12 * (n // 2)), -5.0 * (n // 2), -40.0 + 15 * (n // 2)])
        for n, name in enumerate(HIP_LANDMARKS)
    }
    write_landmarks(folder / "landmarks.json", points)
    return folder


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Layers this small are slower on several threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
def test_one_batch_can_be_learned_by_heart() -> None:
    torch.manual_seed(1)
    network = UNet(UNetConfig(channels=(16, 24, 32), convolutions=(1, 1, 1)))
    images = torch.randn(2, 1, 64, 64)
    labels = torch.randint(0, 2, (2, 4, 4)).repeat_interleave(8, 1).repeat_interleave(8, 2) * 5
    pixels, visible = torch.rand(2, 14, 2) * 31, torch.rand(2, 14) > 0.4
    optimiser = torch.optim.AdamW(network.parameters(), 5e-3)
    for _ in range(150):
        losses = multi_task_loss(network(images), labels, pixels, visible, 1.5, 0.5)
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
    assert losses["segmentation"] < 0.05
    assert losses["landmarks"] < 0.15


def test_a_run_exports_weights_that_load_and_can_be_resumed(settings: Path, case: Path, tmp_path: Path) -> None:
    out, cache = tmp_path / "run", tmp_path / "cache"
    train(settings, out=out, cases=[case], cache=cache)
    weights = out / "hip14.safetensors"
    first = load_network(weights).state_dict()
    assert (out / "checkpoints" / "last.ckpt").is_file()
    with pytest.raises(InputError, match="holds a training run"):
        train(settings, out=out, cases=[case], cache=cache)
    train(settings, out=out, cases=[case], cache=cache, override=["optimisation.epochs=2"], resume=True)
    second = load_network(weights).state_dict()
    assert any(not torch.equal(first[name], second[name]) for name in first)
    views = ViewBatches(sorted(cache.glob("*_??.safetensors")), 2, read_settings(settings).augmentation, 1, 4)
    assert views[3].images.equal(views[3].images)
    assert not views[2].images.equal(views[3].images)


def test_a_cache_of_other_settings_is_refused(settings: Path, case: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    train(settings, out=tmp_path / "run", cases=[case], cache=cache)
    with pytest.raises(InputError, match="rendered with other settings"):
        train(settings, out=tmp_path / "run2", cases=[case], cache=cache, override=["cohort.views=5"])


def test_devices_are_rendered_and_landmarks_found_by_rule_where_asked_for(
    settings: Path, case: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    train(settings, out=tmp_path / "run", cases=[case], cache=cache, override=["cohort.devices=2"])
    assert len(read_devices(cache / "devices.safetensors")) == 2
    with pytest.raises(InputError, match="no obturator foramen"):  # these hip bones are boxes
        train(settings, out=tmp_path / "2", cases=[case], cache=tmp_path / "c2", override=["cohort.landmarks=rules"])


def test_bad_settings(settings: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_settings(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="colour"):
        read_settings(settings, ["augmentation.colour=3"])
    with pytest.raises(InputError, match="nothing to resume"):
        train(settings, out=tmp_path / "run", resume=True)


CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "training"


@pytest.mark.parametrize("name", [path.relative_to(CONFIGS).as_posix() for path in sorted(CONFIGS.rglob("*.yaml"))])
def test_the_shipped_settings(name: str) -> None:
    settings = read_settings(CONFIGS / name, ["optimisation.epochs=3"])
    assert settings.optimisation.epochs == 3
    assert not set(settings.cohort.patient_seeds) & set(settings.cohort.validation_seeds)
    with torch.device("meta"):
        parameters = sum(parameter.numel() for parameter in make_network(settings.network).parameters())
    assert parameters < 8.5e6


def test_a_deeper_network_begins_as_the_shallower_one(settings: Path, tmp_path: Path) -> None:
    """Residual blocks are the identity at first: training from weights that lack them starts where these ended."""
    shallow = read_settings(settings).network
    torch.manual_seed(5)
    network = UNet(shallow).eval()
    save_weights(tmp_path / "shallow.safetensors", network, {})
    deep = UNet(replace(shallow, residual=(1, 0, 2))).eval()
    _begin_with(tmp_path / "shallow.safetensors", deep)
    image = torch.randn(1, 1, 64, 64)
    torch.testing.assert_close(deep(image).heatmaps, network(image).heatmaps)
    with pytest.raises(InputError, match="these weights are of"):
        _begin_with(tmp_path / "shallow.safetensors", UNet(UNetConfig(channels=(8, 12, 24), convolutions=(1, 1, 1))))
