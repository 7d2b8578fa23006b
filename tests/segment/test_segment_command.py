"""`femoreg segment` and `femoreg landmarks` on files."""

import json
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from fuzz_faults import full_after
from hip_scenes import FEMUR_LEFT, HEAD, RADIUS_MM, answering, dice, hip_scene, shares_of
from pelvis_scene import pelvis_scene

from femoreg_torch.commands.main import main
from femoreg_torch.commands.segment import landmarks, segment
from femoreg_torch.segment import load_bone_network
from femoreg_torch.volume import read_label_map, read_landmarks, write_volume

SPACING = (1.5, 1.5, 1.5)


@pytest.fixture
def ct_in_ras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A CT whose index axes run to the right, front and head, as nibabel writes them, and a network that knows it."""
    ct, truth = hip_scene(SPACING)
    write_volume(tmp_path / "lps.nii.gz", ct)
    sitk.WriteImage(sitk.DICOMOrient(sitk.ReadImage(str(tmp_path / "lps.nii.gz")), "RAS"), str(tmp_path / "ct.nii.gz"))
    network = answering(shares_of(truth, SPACING))
    monkeypatch.setattr("femoreg_torch.segment.load_bone_network", lambda path: network)
    return tmp_path / "ct.nii.gz"


def test_the_label_map_lies_on_the_voxels_of_the_file(ct_in_ras: Path, tmp_path: Path) -> None:
    segment(ct_in_ras, out=tmp_path / "labels.nii.gz")
    given, made = nibabel.load(ct_in_ras), nibabel.load(tmp_path / "labels.nii.gz")
    assert made.shape == given.shape
    np.testing.assert_allclose(made.affine, given.affine, atol=1e-4)
    assert made.get_data_dtype() == np.uint8
    _, truth = hip_scene(SPACING)
    assert dice(read_label_map(tmp_path / "labels.nii.gz").data, truth, FEMUR_LEFT) > 0.95
    told = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert told["table"] == "femoreg"
    assert set(told["confidence"]) == {"hip_left", "femur_left"}
    assert (tmp_path / "labels.png").stat().st_size > 1000


def test_the_way_without_a_network_writes_the_same_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ct, truth = pelvis_scene()
    write_volume(tmp_path / "ct.nii.gz", ct)
    out = tmp_path / "labels.nii.gz"
    assert main(["segment", str(tmp_path / "ct.nii.gz"), "--out", str(out), "--way", "graph_cut", "--unrefined"]) == 0
    assert dice(read_label_map(out).data, truth, FEMUR_LEFT) > 0.85
    told = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert told["way"] == "graph_cut"
    assert told["confidence"] == {}
    assert set(told["volume_ml"]) == {"hip_left", "hip_right", "sacrum", "femur_left", "femur_right"}
    assert (tmp_path / "labels.png").stat().st_size > 1000
    assert "mean probability" not in capsys.readouterr().out


@pytest.mark.parametrize("size", [100, 2000])
def test_on_a_full_disk_the_older_files_stay(
    size: int, ct_in_ras: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("labels.nii.gz", "labels.json", "labels.png"):
        (tmp_path / name).write_text("old", encoding="utf-8")
    there = sorted(tmp_path.iterdir())
    with full_after(size):
        assert main(["segment", str(ct_in_ras), "--out", str(tmp_path / "labels.nii.gz")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert ".part" not in error
    assert sorted(tmp_path.iterdir()) == there
    assert {(tmp_path / f"labels.{suffix}").read_text(encoding="utf-8") for suffix in ("nii.gz", "json", "png")} == {
        "old"
    }


def test_the_head_is_proposed_and_what_is_not_there_left_out(
    ct_in_ras: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    segment(ct_in_ras, out=tmp_path / "labels.nii.gz")
    landmarks(ct_in_ras, tmp_path / "labels.nii.gz", out=tmp_path / "points.mrk.json")
    points = read_landmarks(tmp_path / "points.mrk.json")
    np.testing.assert_allclose(points["FH-l"], HEAD, atol=0.7)
    assert not {"FH-r", "SPS-l", "IPS-l", "MOF-l"} & set(points)
    told = capsys.readouterr().out
    assert f"radius {RADIUS_MM:.0f}" in told.replace("22.9", "23").replace("23.1", "23").replace("22.8", "23")
    assert "Left out: FH-r" in told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["segment", "none.nii.gz", "--out", "labels.nii.gz"], "no such file"),
        (["segment", "none.nii.gz", "--out", "labels.png"], "is to end in .nii.gz"),
        (
            ["segment", "none.nii.gz", "--out", "labels.nii.gz", "--way", "graph_cut", "--weights", "w.safetensors"],
            "Leave one of the two out",
        ),
        (["segment", "none.nii.gz", "--out", "labels.nii.gz", "--way", "atlas"], "atlas"),
        (["landmarks", "none.nii.gz", "none.nii.gz", "--out", "points.fcsv"], "is to end in .mrk.json"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def test_a_case_without_labels_is_offered_to_be_segmented(
    ct_in_ras: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["new-case", str(tmp_path / "case"), "--ct", str(ct_in_ras)]
    assert main(arguments) == 2
    assert "--labels is missing (--segment finds" in capsys.readouterr().err
    assert main([*arguments, "--segment"]) == 2
    error = capsys.readouterr().err
    assert "--plan is missing" in error
    assert "--labels" not in error


def test_the_shipped_weights_are_those_of_a_network_of_six_bones() -> None:
    network = load_bone_network()
    assert network.voxel_mm == 3.0
    assert network.multiple == 16
