"""`femoreg train` on a disk that fails at the n-th step: one line, and the next start goes on or begins anew."""

import errno
import json
import logging
import os
import resource
import shutil
import threading
from pathlib import Path

import pytest
from fuzz_faults import FAULT, fault
from tensorboard.summary.writer.record_writer import RecordWriter

from femoreg_torch.commands.main import main
from femoreg_torch.detect import load_network
from training.checkpoints import read_checkpoint
from training.commands import train

SETTINGS = """
cohort: {patient_seeds: [], validation_seeds: [], case_variants: 1, views: 2}
network: {kind: multitask_unet, channels: [4, 8], convolutions: [1, 1]}
loss: {kind: multitask}
optimisation: {epochs: 1, batches_per_epoch: 1, batch_size: 1}
workers: 0
"""
MOST_STEPS = 400


@pytest.fixture(scope="module")
def prepared(case: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command line but for `--out`; its views are rendered."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "tiny.yaml").write_text(SETTINGS, encoding="utf-8")
    train(str(folder / "tiny.yaml"), out=folder / "first", cases=[case], cache=folder / "cache")
    return ["train", str(folder / "tiny.yaml"), "--cases", f"[{case}]", "--cache", str(folder / "cache")]


def whole(out: Path) -> None:
    """What stands in the folder of a run is whole."""
    for path in out.glob("checkpoints/*.ckpt"):
        read_checkpoint(path)
    if (out / "hip14.safetensors").exists():
        load_network(out / "hip14.safetensors")
    if (out / "settings.json").exists():
        json.loads((out / "settings.json").read_text(encoding="utf-8"))


def failing_at(n: int, prepared: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> bool:
    """Train while the n-th step of writing fails, then once more; whether there were so many steps."""
    with fault(out, n):
        status = main([*prepared, "--out", str(out)])
        happened = FAULT.left == 0
    told = capsys.readouterr().err
    assert (status, told.count("\n")) in ((0, 0), (2, 1)), told
    assert "defect" not in told, told
    assert status == 0 or happened, told
    whole(out)
    if status:
        again = ["--resume"] if any(out.glob("checkpoints/*.ckpt")) else []
        status = main([*prepared, "--out", str(out), *again])
        assert (status, capsys.readouterr().err) == (0, "")
        load_network(out / "hip14.safetensors")
        assert again or [path.name for path in (out / "csv").iterdir()] == ["version_0"]  # not mixed with what failed
        assert [path.name for path in out.parent.glob(".*")] + [path.name for path in out.rglob(".*")] == []
    shutil.rmtree(out)
    return happened


@pytest.mark.parametrize("n", [1, 3, 9])
def test_a_step_that_fails(n: int, prepared: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert failing_at(n, prepared, tmp_path / "out", capsys)


def test_what_a_killed_run_left_beside_views_that_are_whole_is_removed(prepared: list[str], tmp_path: Path) -> None:
    (view,) = Path(prepared[-1]).glob("*_00.safetensors")
    left = view.with_name(f".{view.name}.abcd1234.part")
    (left / "new").mkdir(parents=True)
    assert main([*prepared, "--out", str(tmp_path / "out")]) == 0
    assert not left.exists()


def test_nothing_of_what_lightning_tells_stands_on_stderr(prepared: list[str], tmp_path: Path) -> None:
    told: list[str] = []
    ear = logging.Handler(logging.INFO)
    ear.emit = lambda record: told.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("lightning.pytorch").addHandler(ear)
    try:
        assert main([*prepared, "--out", str(tmp_path / "out")]) == 0
    finally:
        logging.getLogger("lightning.pytorch").removeHandler(ear)
    assert told == []


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_disk_that_is_full_for_a_thread_of_logs_is_told_once(
    prepared: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(RecordWriter, "write", full)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # to be given back
    assert main([*prepared, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == f"femoreg: {tmp_path / 'out'}: No space left on device.\n"


def test_a_cache_on_a_disk_without_room_is_told_once(
    case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny.yaml").write_text(SETTINGS, encoding="utf-8")
    arguments = ["train", str(tmp_path / "tiny.yaml"), "--cases", f"[{case}]", "--cache", str(tmp_path / "cache")]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    views = tmp_path / "cache" / f"case_{case.name}_00.safetensors"
    assert capsys.readouterr().err == f"femoreg: {views}: File too large.\n"
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_folder_whose_name_logs_cannot_hold(
    prepared: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*prepared, "--out", str(tmp_path / "out\udcff")]) == 2
    assert "is not UTF-8" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_checkpoints_do_not_come_from_another_disk(
    prepared: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved: list[str] = []
    monkeypatch.setattr(shutil, "move", lambda source, target, *_, **__: moved.append(f"{source} to {target}"))
    left = tmp_path / "out" / "checkpoints" / ".best.ckpt.abcd1234.part"
    left.mkdir(parents=True)
    assert main([*prepared, "--out", str(tmp_path / "out")]) == 0
    assert moved == []
    assert sorted(path.name for path in left.parent.iterdir()) == ["best.ckpt", "last.ckpt"]


def test_a_case_that_lacks_a_landmark(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(case, tmp_path / "case")
    path = tmp_path / "case" / "landmarks.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    del content["landmarks"]["FH-r"]
    path.write_text(json.dumps(content), encoding="utf-8")
    (tmp_path / "tiny.yaml").write_text(SETTINGS, encoding="utf-8")
    arguments = ["train", str(tmp_path / "tiny.yaml"), "--cases", f"[{tmp_path / 'case'}]"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert "it lacks FH-r" in told
    assert told.count("\n") == 1


@pytest.mark.long
def test_every_step_that_fails(prepared: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steps = next(n for n in range(1, MOST_STEPS) if not failing_at(n, prepared, tmp_path / "out", capsys))
    assert steps > 10
