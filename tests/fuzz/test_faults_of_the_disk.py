"""A disk that fails at the n-th step, for every n, and one that is full after so many bytes: all old or all new.

The heavy part of each command is replaced, so that what is tested is how it writes.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from fuzz_doors import doors
from fuzz_faults import FAULT, fault, full_after

import femoreg_torch.evaluation
import femoreg_torch.evaluation.report
import femoreg_torch.evaluation.run
import femoreg_torch.registration.run
import sim.theatre.case_folders
from femoreg_torch.case import read_case, read_result
from femoreg_torch.commands.main import main
from sim.theatre.images import ViewImages
from training.run import export_weights
from training.settings import read_settings


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The valid files of all doors: a case, a result."""
    folder = tmp_path_factory.mktemp("given")
    doors(folder)
    device = trimesh.creation.box((20.0, 10.0, 60.0))
    device.export(folder / "_case" / "case, short" / "device.stl")
    return folder


@pytest.fixture
def commands(given: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Arguments of each command but for `--out`, its heavy part replaced."""
    run, case = given / "_others" / "run", given / "_case" / "case, short"
    result = read_result(run)
    truth = read_case(case).truth
    views = [ViewImages(*(torch.full((8, 8), n, dtype=torch.uint16) for n in (1, 2))) for _ in range(2)]
    monkeypatch.setattr(femoreg_torch.registration.run, "register_scene", lambda *_, **__: (result, None))
    monkeypatch.setattr(femoreg_torch.evaluation, "evaluate", lambda *_: None)
    for name, value in {
        "check_fits": None, "check_plan_fits": None, "prepare_scene": None, "evaluate": None, "draw": None,
        "overlay_figure": np.zeros((9, 9, 3), np.uint8),
    }.items():  # fmt: skip
        monkeypatch.setattr(femoreg_torch.evaluation.run, name, lambda *_, value=value: value)
    monkeypatch.setattr(femoreg_torch.evaluation.report, "report_page", lambda *_: 1000 * "page ")
    for name, value in {
        "read_mesh": None, "_case_scan": (None, None), "metal_in_beam": None, "simulate_images": views,
        "draw_procedure": SimpleNamespace(truth=truth), "write_preview": None,
    }.items():  # fmt: skip
        monkeypatch.setattr(sim.theatre.case_folders, name, lambda *_, value=value: value)
    return {
        "register": ["register", str(case)],
        "evaluate": ["evaluate", str(case)],
        "navigate": ["navigate"],
        "simulate": ["simulate", str(case)],
    }


def state(folder: Path) -> dict[str, bytes] | None:
    """All files and their contents, but for what tells the time; None if there is no folder."""
    if not folder.exists():
        return None
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def prepared(out: Path, name: str, given: Path, old: bool) -> None:
    """What stands in `out` before a command runs."""
    if name in ("evaluate", "navigate") or old:
        out.mkdir(exist_ok=True)
    if name in ("evaluate", "navigate"):
        (out / "result.json").write_bytes((given / "_others" / "run" / "result.json").read_bytes())
    if old:
        for file in ("result.json", "navigation.json", "report.html", "case.yaml", "notes.txt"):
            if not (out / file).exists():
                (out / file).write_text("old", encoding="utf-8")


def arguments(command: list[str], out: Path) -> list[str]:
    """The command line that writes to `out`."""
    return [*command, str(out)] if command[0] in ("evaluate", "navigate") else [*command, "--out", str(out)]


@pytest.mark.parametrize("old", [False, True], ids=["new", "over an old one"])
@pytest.mark.parametrize("name", ["register", "evaluate", "navigate", "simulate"])
def test_whichever_step_of_writing_fails_all_is_old_or_all_is_new(
    name: str,
    old: bool,
    commands: dict[str, list[str]],
    given: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, found, n = tmp_path / "out", [], 0
    while True:
        n += 1
        prepared(out, name, given, old)
        before = state(out)
        with fault(tmp_path, n):
            status = main(arguments(commands[name], out))
            happened = FAULT.left == 0
        told = capsys.readouterr().err
        if not happened:
            assert (status, told) == (0, "")
            complete = state(out)
            break
        found.append((before, state(out)))
        if told:  # or it was a call that may fail, such as making a folder that is there
            assert (status, told.count("\n")) == (2, 1)
            assert "No space left on device" in told
        assert [path.name for path in tmp_path.iterdir() if path != out] == []  # cleaned up
        _remove(out)
    assert n > 3
    assert complete is not None
    for before, after in found:
        assert after in (before, complete)


def _remove(out: Path) -> None:
    for path in sorted(out.rglob("*"), reverse=True) if out.exists() else []:
        path.rmdir() if path.is_dir() else path.unlink()
    if out.exists():
        out.rmdir()


@pytest.mark.parametrize("size", [0, 1, 300, 1500])
@pytest.mark.parametrize("name", ["register", "evaluate", "navigate", "simulate"])
def test_on_a_full_disk_nothing_changes(
    name: str,
    size: int,
    commands: dict[str, list[str]],
    given: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    prepared(out, name, given, old=True)
    before = state(out)
    with full_after(size):
        status = main(arguments(commands[name], out))
    told = capsys.readouterr().err
    if size > 300 and status == 0:  # all files are shorter
        return
    assert (status, told.count("\n")) == (2, 1), told
    assert "defect" not in told
    assert state(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("size", [0, 100, 1000])
def test_weights_are_exported_whole_or_not_at_all(size: int, tmp_path: Path) -> None:
    settings = read_settings("quick", ["network.channels=[4, 4]", "network.convolutions=[1, 1]"])
    network = settings.network.build()
    state_dict = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save({"state_dict": state_dict, "global_step": 7}, tmp_path / "best.ckpt")
    (tmp_path / "w.safetensors").write_text("old", encoding="utf-8")

    def export() -> Path:
        return export_weights(tmp_path / "best.ckpt", settings, tmp_path / "w.safetensors")

    with full_after(size), pytest.raises(OSError, match=r"w\.safetensors"):
        export()
    assert (tmp_path / "w.safetensors").read_text(encoding="utf-8") == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["best.ckpt", "w.safetensors"]
    _fails_at_every_step(export, tmp_path)


def _fails_at_every_step(write: Callable[[], Any], folder: Path) -> None:
    for n in range(1, 30):
        with fault(folder, n), suppress(OSError):
            write()
            if FAULT.left > 0:
                assert n > 4
                return
        assert (folder / "w.safetensors").read_bytes() == b"old"
    raise AssertionError("more steps than expected")
