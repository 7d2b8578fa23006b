"""Commands on broken results and with broken arguments: status 0 or 2, one line on stderr, nothing half-written."""

import os
import random
import time
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from fuzz_doors import doors
from fuzz_mutators import NASTY, mutated_text

import femoreg_torch.evaluation.report
import femoreg_torch.evaluation.run
from femoreg_torch.commands import main as module
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError

SEED = int(os.environ.get("FEMOREG_FUZZ_SEED", time.time_ns() % 2**31))
COUNT = int(os.environ.get("FEMOREG_FUZZ_COUNT", 400)) // 10
_OPTIONS = (
    "--out", "--seed", "--preset", "--weights", "--landmarks", "--start", "--robot", "--config", "--jobs", "--count",
    "--spacing-mm", "--side", "--override", "--cases", "--intensity", "--carm", "--require-trust", "--nothing", "-n",
)  # fmt: skip


def test_broken_results_by_the_commands_that_read_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The pictures of `evaluate` are left out: they are drawn from the case, which is whole."""
    draw = random.Random(SEED)
    (door,) = (door for door in doors(tmp_path) if door.name == "result")
    run, case = door.path.parent, tmp_path / "_case" / "case, short"
    monkeypatch.setattr(femoreg_torch.evaluation.run, "prepare_scene", lambda *_: None)
    monkeypatch.setattr(femoreg_torch.evaluation.run, "evaluate", lambda *_: None)
    monkeypatch.setattr(femoreg_torch.evaluation.run, "draw", lambda *_: None)
    monkeypatch.setattr(femoreg_torch.evaluation.report, "report_page", lambda *_: "page")
    monkeypatch.setattr(femoreg_torch.evaluation.run, "overlay_figure", lambda *_: np.zeros((9, 9, 3), np.uint8))
    capfd.readouterr()
    finds = []
    for number in range(COUNT):
        for file in run.iterdir():
            if file.is_file():
                file.unlink()
        door.path.write_bytes(mutated_text(door.content, True, b"{}", draw))
        command = ["navigate", str(run)] if number % 2 else ["evaluate", str(case), str(run)]
        status = main(command)
        told = capfd.readouterr().err
        there = {file.name for file in run.iterdir()}
        whole = {"result.json"} if status else {"result.json", *_written(command[0])}
        if status not in (0, 2) or told.count("\n") != status // 2 or "defect" in told or not whole <= there:
            finds.append(f"{command[0]}: {status} {told[:300]}")
        if status and there - {"result.json", "navigation"}:
            finds.append(f"{command[0]}: leaves {there}")
    assert sorted(set(finds)) == [], f"seed {SEED}"


def _written(command: str) -> set[str]:
    return {"navigation.json", "navigation"} if command == "navigate" else {"overlay.png", "report.html"}


def test_broken_arguments_are_refused_or_parsed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    draw = random.Random(SEED)
    commands = [(command.name, command.load()) for command in entry_points(group=module.GROUP)]
    finds = []
    for _ in range(COUNT):
        name, function = draw.choice(commands)
        words = []
        for _n in range(draw.randrange(6)):
            value = draw.choice(NASTY)[: draw.choice((5, 100, 100_000))].replace("\0", "")
            words += draw.choice(([draw.choice(_OPTIONS)], [value], [draw.choice(_OPTIONS), value]))
        if "--help" in words or "-h" in words:
            continue
        try:
            module._parse(function, name, words)
        except InputError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                finds.append(f"{name} {words!r}"[:300])
        except Exception as error:
            finds.append(f"{type(error).__name__}: {error} for {name} {words!r}"[:400])
    assert capfd.readouterr().err == ""
    assert sorted(set(finds)) == [], f"seed {SEED}"
