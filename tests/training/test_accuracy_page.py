"""The files of a measurement: figures by the names of bones and landmarks, and what was not measured left out."""

import json
from pathlib import Path

import numpy as np
import pytest

from femoreg_torch.anatomy import HIP
from training.accuracy_page import write_accuracy
from training.measure import Reading
from training.robustness import Outcomes


@pytest.fixture
def readings() -> list[Reading]:
    """One image in which all is 2 mm off, right, and certain."""
    count = len(HIP.landmarks)
    yes, overlap = np.ones(count, dtype=bool), np.tile([3.0, 4.0], (len(HIP.bones), 1))
    certain, pose = np.ones(count), np.array([2.0, 3.0, 4.0])
    return [Reading("one", np.full(count, 2.0), yes, yes, certain, overlap, True, False, pose)]


def test_figures_are_told_by_name(readings: list[Reading], tmp_path: Path) -> None:
    page = write_accuracy(tmp_path / "out", readings, {"turned": Outcomes(5, 3, 1)})
    assert page == (tmp_path / "out" / "accuracy.md").read_text(encoding="utf-8")
    lines = page.splitlines()
    assert "| Dice, femur left | 0.75 (0.75 to 0.75) |" in lines
    assert "| landmark error, median | 2.0 mm (2.0 to 2.0) |" in lines
    assert "| GSN-r | 2.0 | 2.0 | 100 % | 1 |" in lines
    assert "| turned | 5 | 3 | 1 |" in lines
    content = json.loads((tmp_path / "out" / "accuracy.json").read_text(encoding="utf-8"))
    assert content["landmarks"]["ASIS-l"]["recall"] == 1
    assert content["measures"]["pose_fair"]["value"] == 1
    assert content["calibration_error"] == 0
    assert (tmp_path / "out" / "reliability.png").is_file()


def test_what_was_not_measured_is_left_out(readings: list[Reading], tmp_path: Path) -> None:
    page = write_accuracy(tmp_path, readings, {})
    assert "altered" not in page
    assert "| pelvis within 1° after single-view registration | – |" in page.splitlines()
