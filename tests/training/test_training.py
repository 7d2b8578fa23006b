"""Learning on a CPU in seconds: one batch by heart, and one run from a case folder to exported weights."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import RichProgressBar, TQDMProgressBar
from rich.console import Console
from safetensors.torch import load_file

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from models.losses import MultiTaskLoss
from models.unet import UNetSettings
from models.weights import Weights, save_weights
from training.commands import train
from training.data import ViewBatches
from training.devices import read_devices
from training.run import begin_with, progress_bar
from training.settings import read_settings

LANDMARKS, CLASSES = len(HIP.landmarks), 1 + len(HIP.bones)

SETTINGS = """
cohort:
  patient_seeds: []
  validation_seeds: []
  case_variants: 2
  views: 3
network:
  kind: multitask_unet
  channels: [8, 12, 16]
  convolutions: [1, 1, 1]
loss:
  kind: multitask
optimisation:
  epochs: 1
  batches_per_epoch: 2
  batch_size: 2
workers: 0
"""


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "tiny.yaml"
    path.write_text(SETTINGS, encoding="utf-8")
    return str(path)


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
    network = UNetSettings(CLASSES, LANDMARKS, channels=(16, 24, 32), convolutions=(1, 1, 1)).build()
    loss = MultiTaskLoss(sigma_px=1.5, landmark_weight=0.5)
    images = torch.randn(2, 1, 64, 64)
    labels = torch.randint(0, 2, (2, 4, 4)).repeat_interleave(8, 1).repeat_interleave(8, 2) * (CLASSES - 1)
    pixels, visible = torch.rand(2, LANDMARKS, 2) * 31, torch.rand(2, LANDMARKS) > 0.4
    optimiser = torch.optim.AdamW(network.parameters(), 5e-3)
    for _ in range(150):
        losses = loss(network(images), labels, pixels, visible)
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
    assert losses["segmentation"] < 0.05
    assert losses["landmarks"] < 0.15


def usual_mode(folder: Path) -> int:
    """Of a new file, by the umask."""
    (folder / "new").touch()
    return (folder / "new").stat().st_mode & 0o777


def test_a_run_exports_weights_that_load_and_can_be_resumed(
    settings: str, case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, cache = tmp_path / "run", tmp_path / "cache"
    train(settings, out=out, cases=[case], cache=cache)
    weights = out / "hip14.safetensors"
    first = load_network(weights).module.state_dict()
    assert (out / "checkpoints" / "last.ckpt").is_file()
    with pytest.raises(InputError, match="holds a training run"):
        train(settings, out=out, cases=[case], cache=cache)
    train(settings, out=out, cases=[case], cache=cache, override=["optimisation.epochs=2"], resume=True)
    assert "Epoch 2/2" in capsys.readouterr().out  # and not 1/1
    assert {path.stat().st_mode & 0o777 for path in (weights, *cache.iterdir())} == {usual_mode(tmp_path)}
    second = load_network(weights).module.state_dict()
    assert any(not torch.equal(first[name], second[name]) for name in first)
    again = partial(train, settings, out=out, cache=cache, resume=True)
    with pytest.raises(InputError, match="has had 2 epochs, and the settings ask for 1"):
        again(cases=[case], override=["optimisation.epochs=1"])
    with pytest.raises(InputError, match="another `cases`"):
        again(override=["optimisation.epochs=3"])
    with pytest.raises(InputError, match="another `cohort`"):
        again(cases=[case], override=["cohort.views=5"])
    with pytest.raises(InputError, match="goes on with its own weights"):
        again(cases=[case], start=weights)
    card = (out / "card.md").read_text(encoding="utf-8")
    assert "4 steps of 2 images (8 images)" in card
    assert f"| {case.name} | 2 | 6 | not told | not told |" in card
    views = ViewBatches(sorted(cache.glob("*_??.safetensors")), 2, read_settings(settings).run.augmentation, 1, 4)
    assert views[3].images.equal(views[3].images)
    assert not views[2].images.equal(views[3].images)


@pytest.mark.parametrize("kept", [True, False])
def test_a_run_that_is_interrupted_says_how_it_goes_on(
    settings: str, case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    """Lightning leaves Python where Ctrl-C is pressed, and where the system ends it."""

    def stopped(*_: object, **__: object) -> None:
        if kept:
            (tmp_path / "run" / "checkpoints").mkdir()
            (tmp_path / "run" / "checkpoints" / "last.ckpt").touch()
        raise SystemExit(1)

    monkeypatch.setattr(Trainer, "fit", stopped)
    with pytest.raises(KeyboardInterrupt, match="go on with --resume" if kept else "nothing is kept"):
        train(settings, out=tmp_path / "run", cases=[case])


def test_a_cache_of_other_settings_is_refused(settings: str, case: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    train(settings, out=tmp_path / "run", cases=[case], cache=cache)
    with pytest.raises(InputError, match="rendered with other settings"):
        train(settings, out=tmp_path / "run2", cases=[case], cache=cache, override=["cohort.views=5"])


def test_devices_are_rendered_and_landmarks_found_by_rule_where_asked_for(
    settings: str, case: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    train(settings, out=tmp_path / "run", cases=[case], cache=cache, override=["cohort.devices=2"])
    assert len(read_devices(cache / "devices.safetensors")) == 2
    by_rule = tmp_path / "c2"
    train(settings, out=tmp_path / "2", cases=[case], cache=by_rule, override=["cohort.landmarks=rules"])
    views = sorted(cache.glob("case_*_??.safetensors"))
    assert len(views) == 2
    for file in views:
        carried, found = (load_file(path)["landmarks"] for path in (file, by_rule / file.name))
        assert torch.equal(carried, found)  # these hip bones are boxes, without a foramen that the rules need


def test_bad_settings(settings: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_settings(str(tmp_path / "none.yaml"))
    with pytest.raises(InputError, match="colour"):
        read_settings(settings, ["augmentation.colour=3"])
    with pytest.raises(InputError, match="nothing to resume"):
        train(settings, out=tmp_path / "run", resume=True)


def test_presets_are_found_by_name_or_file_and_overridden() -> None:
    settings = read_settings("hip14", ["optimisation.epochs=3", "network.residual=null", "loss.sigma_px=2e0"])
    assert settings.run.optimisation.epochs == 3
    assert settings.run.optimisation.learning_rate == 1.5e-3
    assert settings.network == UNetSettings(CLASSES, LANDMARKS, channels=(48, 80, 128, 192), convolutions=(1, 2, 2, 2))
    assert settings.loss == MultiTaskLoss(sigma_px=2.0, landmark_weight=1.0)
    for override, message in {
        "optimisation.epochs": "group.key=value was expected",
        "colour=3": "unknown key 'colour'",
        "network.kind=vision_transformer": "vision_transformer",
        "network.depth=3": "unknown key 'depth'",
        "network.landmarks=3": "3 landmarks, but the anatomy hip has",
        "loss=3": "loss: a mapping",
        "optimisation.epochs=many": "optimisation.epochs",
        "optimisation.epochs=[": "cannot be read as YAML",
    }.items():
        with pytest.raises(InputError, match=message):
            read_settings("hip14", [override])


CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "training"


@pytest.mark.parametrize("name", [path.relative_to(CONFIGS).as_posix() for path in sorted(CONFIGS.rglob("*.yaml"))])
def test_the_shipped_settings(name: str) -> None:
    settings = read_settings(str(CONFIGS / name))
    cohort = settings.run.cohort
    assert not set(cohort.patient_seeds) & set(cohort.validation_seeds)
    with torch.device("meta"):
        parameters = sum(parameter.numel() for parameter in settings.network.build().parameters())
    assert parameters < 8.5e6


def test_the_ablation_differs_from_its_base_in_what_its_names_say() -> None:
    base, *others = (
        read_settings(str(CONFIGS / "ablation" / f"{name}.yaml"))
        for name in ("full", "no_deformation", "no_randomisation", "procedural_only", "real_only")
    )
    deformation, randomisation, procedural, real = (other.run for other in others)
    assert all((other.network, other.loss) == (base.network, base.loss) for other in others)
    cohort = base.run.cohort
    assert deformation == replace(base.run, cohort=replace(cohort, patient_variants=1, case_variants=1))
    assert replace(randomisation, augmentation=base.run.augmentation) == base.run
    assert randomisation.augmentation.rotation_deg == base.run.augmentation.rotation_deg
    assert randomisation.augmentation.unevenness == 0
    assert procedural == base.run
    assert real == replace(base.run, cohort=replace(cohort, patient_seeds=[]))


def test_a_deeper_network_begins_as_the_shallower_one(settings: str, tmp_path: Path) -> None:
    """Residual blocks are the identity at first: training from weights that lack them starts where these ended."""
    shallow = UNetSettings(CLASSES, LANDMARKS, channels=(8, 12, 16), convolutions=(1, 1, 1))
    torch.manual_seed(5)
    network = shallow.build().eval()
    path = tmp_path / "shallow.safetensors"
    save_weights(path, Weights("multitask_unet", asdict(shallow), HIP.name, 1.5, network.state_dict()), {})
    deep = replace(shallow, residual=(1, 0, 2)).build()
    begin_with(path, deep)
    assert deep.training
    image = torch.randn(1, 1, 64, 64)
    torch.testing.assert_close(deep.eval()(image).heatmaps, network(image).heatmaps)
    for other in (replace(shallow, channels=(8, 12, 24)), replace(shallow, convolutions=(2, 1, 1))):
        with pytest.raises(InputError, match="is not that of these weights"):
            begin_with(path, other.build())


def test_a_notebook_gets_a_bar_that_works_there() -> None:
    assert isinstance(progress_bar(Console(force_jupyter=True)), TQDMProgressBar)
    assert isinstance(progress_bar(Console(force_jupyter=False)), RichProgressBar)
