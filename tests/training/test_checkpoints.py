"""Runs that cannot go on as they are told to: checkpoints cut off or of another network, no GPU, odd overrides."""

import os
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from models.unet import UNetSettings
from models.weights import Weights, save_weights
from training.checkpoints import BestCheckpoint, last_good_checkpoint, read_checkpoint
from training.module import NetworkTraining
from training.run import Machine, train_network
from training.settings import TrainingSettings, read_settings

SMALL = ["network.channels=[4, 4]", "network.convolutions=[1, 1]"]


def settings(*overrides: str) -> TrainingSettings:
    return read_settings("quick", [*SMALL, *overrides])


def training(told: TrainingSettings) -> NetworkTraining:
    return NetworkTraining(told.network, told.loss, told.run.optimisation)


def written(path: Path, module: NetworkTraining, age: int) -> Path:
    state = {"epoch": 1, "loops": {}, "optimizer_states": [], "lr_schedulers": []}
    torch.save({"state_dict": module.state_dict(), "global_step": 5, **state}, path)
    os.utime(path, (1000 - age, 1000 - age))
    return path


def test_a_truncated_checkpoint_is_told_and_passed_over(tmp_path: Path) -> None:
    module = training(settings())
    last = written(tmp_path / "last.ckpt", module, 0)
    best = written(tmp_path / "best.ckpt", module, 60)
    told: list[str] = []
    assert last_good_checkpoint(tmp_path, module, told.append) == (last, 2)
    content = last.read_bytes()
    for length in (0, 10, len(content) // 2, len(content) - 10):
        last.write_bytes(content[:length])
        assert last_good_checkpoint(tmp_path, module, told.append) == (best, 2)
    assert len(told) == 4
    assert all("last.ckpt: is cut off" in line and "\n" not in line for line in told)
    best.write_bytes(b"")
    with pytest.raises(InputError, match="holds no whole checkpoint"):
        last_good_checkpoint(tmp_path, module, told.append)


def best_of(folder: Path, kind: type[ModelCheckpoint] = BestCheckpoint) -> ModelCheckpoint:
    return kind(folder, "best", monitor="loss", save_last=True, enable_version_counter=False)


def test_what_was_best_stays_known_where_the_run_was_moved(tmp_path: Path) -> None:
    old, new = tmp_path / "old" / "checkpoints", tmp_path / "new" / "checkpoints"
    before = best_of(old, ModelCheckpoint)  # also of a run of Lightning's own
    before.best_model_path, before.kth_best_model_path = str(old / "best.ckpt"), str(old / "best.ckpt")
    before.last_model_path = str(old / "last.ckpt")
    before.best_model_score = before.kth_value = torch.tensor(3.8)
    before.best_k_models = {before.best_model_path: before.best_model_score}
    new.mkdir(parents=True)
    (new / "best.ckpt").touch()
    after = best_of(new)
    assert after.state_key == before.state_key
    after.load_state_dict(before.state_dict())
    assert after.best_model_path == str(new / "best.ckpt")
    assert list(after.best_k_models) == [after.best_model_path]
    assert after.kth_best_model_path == after.best_model_path
    assert after.best_model_score == torch.tensor(3.8)


def test_weights_without_the_state_of_a_run_are_passed_over(tmp_path: Path) -> None:
    module = training(settings())
    best = written(tmp_path / "best.ckpt", module, 60)
    torch.save({"state_dict": module.state_dict(), "global_step": 9}, tmp_path / "last.ckpt")
    told: list[str] = []
    assert last_good_checkpoint(tmp_path, module, told.append) == (best, 2)
    assert "last.ckpt: holds weights, but not the state of a run" in told[0]


def test_a_checkpoint_of_other_channels_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "last.ckpt", training(settings()), 0)
    other = training(settings("network.channels=[4, 6]"))
    with pytest.raises(InputError, match="is of another network than the settings name"):
        last_good_checkpoint(tmp_path, other, print)


def test_a_checkpoint_runs_no_code(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (tmp_path / "done",)

    torch.save({"state_dict": Evil(), "global_step": 5}, tmp_path / "last.ckpt")
    with pytest.raises(InputError, match=r"last\.ckpt: is cut off, damaged, or no checkpoint"):
        read_checkpoint(tmp_path / "last.ckpt")
    assert not (tmp_path / "done").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_without_a_gpu_is_refused_before_anything_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--device cuda: 1 GPUs were asked for, torch sees 0"):
        train_network(settings(), [], tmp_path / "run", tmp_path / "cache", machine=Machine("cuda"))
    assert list(tmp_path.iterdir()) == []


def test_weights_of_other_landmarks_to_start_with_are_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = {"classes": 7, "landmarks": 5, "channels": (2, 2), "convolutions": (1, 1)}
    state = UNetSettings(**other).build().state_dict()
    save_weights(tmp_path / "w.safetensors", Weights("multitask_unet", other, "hip", 1.25, state), {})
    assert main(["train", "quick", "--out", str(tmp_path / "out"), "--start", str(tmp_path / "w.safetensors")]) == 2
    told = capfd.readouterr().err
    assert "5 landmarks" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_word_in_place_of_a_list_is_told_briefly(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "quick", "--out", str(tmp_path / "out"), "--override", "x"]) == 2
    told = capfd.readouterr().err
    assert "--override: a list of texts was expected, found 'x'" in told
    assert "--override '[A, B]'" in told
    assert "class" not in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    "override",
    [
        "[1, 2]", "cohort=[1, 2]", "network=[1]", "network.landmarks=15", "network.channels=[]",
        "optimisation.epochs=0",
        "optimisation.epochs=1e99", "cohort.views=-1", "=3", "loss=3", "optimisation.learning_rate=true",
        "optimisation.epochs=!!int 3", "cohort.patient_seeds=[-1]", "augmentation.scale=[2, 1]", "x" * 10_000 + "=1",
    ],
)  # fmt: skip
def test_odd_overrides_are_one_line(override: str) -> None:
    with pytest.raises(InputError) as raised:
        settings(override)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 1500


def test_a_checkpoint_of_another_pickle_protocol_prints_nothing(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """torch warns of it, and then refuses what it cannot read."""
    torch.save({"state_dict": {}, "global_step": 5}, tmp_path / "a.ckpt", pickle_protocol=4)
    with suppress(InputError):
        read_checkpoint(tmp_path / "a.ckpt")
    assert len(recwarn) == 0
