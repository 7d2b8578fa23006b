"""The files of a measurement: figures by the names of bones and landmarks, and what was not measured left out."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fuzz_faults import full_after

import femoreg_torch.detect
import training.measure
from femoreg_torch.anatomy import HIP
from femoreg_torch.commands.main import main
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
    assert "| Dice, femur left | 0.75 |" in lines
    assert "| landmark error, median | 2.0 mm |" in lines
    assert "| GSN-r | 2.0 | 2.0 | 100 % | 1 |" in lines
    assert "| turned | 5 | 3 | 1 |" in lines
    content = json.loads((tmp_path / "out" / "accuracy.json").read_text(encoding="utf-8"))
    assert content["landmarks"]["ASIS-l"]["recall"] == 1
    assert content["measures"]["pose_fair"]["value"] == 1
    assert content["calibration_error"] == 0
    assert (tmp_path / "out" / "reliability.png").is_file()


def test_several_patients_have_intervals_and_landmarks_that_no_image_shows_a_dash(
    readings: list[Reading], tmp_path: Path
) -> None:
    unseen = np.array([name != "GSN-r" for name in HIP.landmark_names])
    other = replace(readings[0], patient="two", error_mm=np.full(len(unseen), 4.0))
    both = [replace(one, visible=unseen, found=unseen) for one in (readings[0], other)]
    lines = write_accuracy(tmp_path, both, {}).splitlines()
    assert lines[0].startswith("2 images of 2 patients.")
    assert "| landmark error, mean | 3.0 mm (2.0 to 4.0) |" in lines
    assert "| GSN-r | – | – | – | 0 |" in lines


def test_views_from_several_sides_have_a_line_for_each(readings: list[Reading], tmp_path: Path) -> None:
    assert "| source |" not in write_accuracy(tmp_path / "one", readings, {})
    refused = replace(readings[0], source="left", refused=True, pose_error=np.full(3, np.nan))
    lines = write_accuracy(tmp_path / "two", [*readings, *readings, refused], {}).splitlines()
    assert "| anterior | 2 | 2.0 mm | 100.0 % | – | 100.0 % | 0.0 % |" in lines
    assert "| left | 1 | 2.0 mm | 100.0 % | – | 0.0 % | 100.0 % |" in lines


def test_what_was_not_measured_is_left_out(readings: list[Reading], tmp_path: Path) -> None:
    page = write_accuracy(tmp_path, readings, {})
    assert "altered" not in page
    assert "| pelvis within 1° after single-view registration | – |" in page.splitlines()


@pytest.mark.parametrize("command", ["measure", "benchmark"])
def test_on_a_full_disk_no_part_of_the_files_is_written(
    command: str, readings: list[Reading], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(femoreg_torch.detect, "load_network", lambda _: None)
    monkeypatch.setattr(training.measure, "read_images", lambda *_, **__: readings)
    (tmp_path / "a.h5").touch()
    files = ["deepfluoro", str(tmp_path / "a.h5"), "--detection-only"] if command == "benchmark" else [str(tmp_path)]
    with full_after(12_000):  # the picture is larger
        assert main([command, *files, "--out", str(tmp_path / "out")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]
    assert main([command, *files, "--out", str(tmp_path / "out")]) == 0
    assert len(list((tmp_path / "out").iterdir())) == (4 if command == "benchmark" else 3)
