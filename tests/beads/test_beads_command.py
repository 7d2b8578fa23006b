"""From a case with beads in CT and images to its truth, a case without beads, and Table III."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
import trimesh
import yaml
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage

from femoreg_torch.beads import find_spots, read_trials
from femoreg_torch.case import ObjectQuality, Result, read_case, result_content, write_json
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.fluoro import attenuation_image, read_image, write_image
from femoreg_torch.geometry import (
    Poses,
    about_point,
    centred_camera,
    exp_se3,
    pose_difference,
    project_points,
    rigid,
    transform_points,
)
from femoreg_torch.volume import Volume, axis_aligned, read_ct, write_landmarks, write_volume
from sim.physics.spheres import areal_spheres
from sim.theatre.beads import PlacedBeads, ct_with_beads

CAMERA = centred_camera(1000.0, (0.3, 0.3), (480, 480))
BONE = torch.tensor(
    [[18.3, 22.1, 60.7], [34.2, 30.8, 55.4], [25.6, 38.3, 46.9], [38.9, 20.2, 33.1], [21.4, 33.7, 20.8]]
).double()
TOOL = torch.tensor([[11.0, 2, 8], [-9, -6, 19], [4, 9, 33], [-7, 5, 47], [10, -4, 55]]).double()
TURN = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)


def turned(twist: tuple[float, ...], centre: tuple[float, float, float]) -> torch.Tensor:
    """A motion (4, 4) by a twist (rad, mm) about a point."""
    return about_point(exp_se3(torch.tensor(twist, dtype=torch.float64)), torch.tensor(centre, dtype=torch.float64))


TOOL_AT = (5.0, -20.0, 600.0)
TRUE = Poses(
    torch.stack([turned((0, angle, 0, 0, 0, 0), (0, 0, 650)) for angle in (0.0, 0.3)]),
    {
        "femur": rigid(TURN, torch.tensor([-38.0, 52, 690]).double()),
        "device": turned((0.2, -0.1, 0.1, 6, 4, 3), TOOL_AT) @ rigid(TURN, torch.tensor([5.0, 10, 600]).double()),
    },
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A case of a bone and a tool with beads in two views, and its beads.yaml."""
    place = tmp_path / "case"
    place.mkdir()
    generator = torch.Generator().manual_seed(0)
    labels = torch.zeros(80, 60, 60, dtype=torch.uint8)
    labels[8:72, 10:50, 10:50] = 5
    affine = axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    hu = torch.where(labels > 0, 400.0, -80.0) + 15 * torch.randn(labels.shape, generator=generator)
    write_volume(place / "ct.nii.gz", ct_with_beads(Volume(hu, affine), PlacedBeads(BONE, 2.0), 0.5))
    write_volume(place / "labels.nii.gz", Volume(labels, affine))
    trimesh.creation.box((8, 8, 60), transform=trimesh.transformations.translation_matrix([0, 0, 30])).export(
        place / "device.stl"
    )
    write_landmarks(place / "tool.mrk.json", {f"t{n}": point for n, point in enumerate(TOOL)})
    rows, columns = np.mgrid[:480, :480]
    tissue = torch.from_numpy(1.5 + 0.3 * np.sin(columns / 60) + 0.2 * np.cos(rows / 45))
    for view in range(2):
        for kind, names in (("plain", ("femur",)), ("tool", ("femur", "device"))):
            steel = torch.zeros(CAMERA.shape, dtype=torch.float64)
            for name in names:
                places = transform_points(TRUE.camera_from(name)[view], {"femur": BONE, "device": TOOL}[name])
                steel += areal_spheres(places, 1.0, 7.95, CAMERA)
            counts = 40_000 * (-tissue - 0.8 * steel).exp()
            counts += counts.sqrt() * 2 * torch.randn(counts.shape, generator=generator).double()
            write_image(place / f"v{view + 1}_{kind}.tif", counts.clamp(1, 65535).round().to(torch.uint16))
    nominal = turned((0.04, 0.03, -0.05, 5, -4, 6), TOOL_AT)
    content = {
        "version": 2,
        "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": {"shaft": 5}},
        "objects": {
            "femur": {
                "bones": "shaft",
                "reference": [30, 30, 40],
                "start": {"camera1_from": TRUE.camera1_from["femur"].tolist()},
            },
            "device": {
                "model": "device.stl",
                "hu": 5000,
                "points": {"tip": [0, 0, 60], "base": [0, 0, 0]},
                "reference": [0, 0, 30],
                "images": "tool",
                "start": {"camera1_from": (nominal @ TRUE.camera1_from["device"]).tolist()},
            },
        },
        "plan": {"object": "femur", "entry_point": [30, 30, 10], "target": [30, 30, 60], "tool": "device"},
        "carm": {"sdd_mm": 1000, "pixel_mm": [0.3, 0.3], "shape": [480, 480]},
        "views": [{"images": {"plain": f"v{v}_plain.tif", "tool": f"v{v}_tool.tif"}} for v in (1, 2)],
    }
    (place / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    (place / "beads.yaml").write_text(
        "objects:\n  femur: {points: ct, count: 5, diameter_mm: 2}\n"
        "  device: {points: tool.mrk.json, diameter_mm: 2, noise_mm: 0}\n",
        encoding="utf-8",
    )
    return place


def test_beads_give_the_truth_and_are_taken_out(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    against_schema: Callable[[str, Any], list[str]],
) -> None:
    assert not against_schema("beads", yaml.safe_load((folder / "beads.yaml").read_text(encoding="utf-8")))
    out = tmp_path / "trials" / "I"
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(out)]) == 0
    case = read_case(out)
    assert case.truth is not None
    for name, point in (("femur", [30.0, 30, 40]), ("device", [0.0, 0, 30])):
        angle, shifted = pose_difference(
            TRUE.camera1_from[name], case.truth.camera1_from[name], torch.tensor(point).double()
        )
        assert angle < 0.3
        assert shifted < 0.6
    told = read_json(out / "truth_uncertainty.json")
    assert not against_schema("truth_uncertainty", told)
    assert told["shadows"]["used"] >= 25  # of 5 in four images and 5 in two
    assert 0.02 <= told["image_noise_px"] < 0.2
    assert told["deviations"]["femur"]["mm"] < 0.8
    rows = list(csv.DictReader((out / "beads.csv").open(encoding="utf-8")))
    assert len(rows) == told["shadows"]["given"]
    assert {row["object"] for row in rows} == {"femur", "device"}
    ct = read_ct(out / "ct.nii.gz")
    assert ct.data.max() < 700  # the beads were at 3071
    for view in case.views:
        for path in view.images.values():
            assert len(find_spots(attenuation_image(read_image(path)), 4.8)) == 0
    assert (out / "beads.png").is_file()
    # a registration that is off by 1 mm in depth, and one that is right
    for offset in (1.0, 0.0):
        moved = rigid(translation=torch.tensor([0.0, 0, offset]).double())
        placed = {"femur": moved @ case.truth.camera1_from["femur"], "device": case.truth.camera1_from["device"]}
        poses = Poses(case.truth.camera_from_camera1, placed)
        sure = ObjectQuality((), 0.9, (0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), None, True, "")
        result = Result(poses, quality=dict.fromkeys(case.objects, sure), path=("femur", "device"))
        (out / "run").mkdir(exist_ok=True)
        write_json(out / "run" / "result.json", result_content(result))
        (trial,) = read_trials(tmp_path / "trials")
        assert trial.errors["entry_point_mm"] == pytest.approx(offset, abs=1e-6)
        assert trial.errors["relative_mm"] == pytest.approx(offset, abs=1e-6)
        assert trial.truth["entry_point_mm"] > 0.05
    told = json.loads((out / "truth_uncertainty.json").read_text(encoding="utf-8"))
    (out / "truth_uncertainty.json").write_text(json.dumps(told | {"metrics": {}}), encoding="utf-8")
    with pytest.raises(InputError, match=r"truth_uncertainty\.json, metrics\.\w+: is missing"):
        read_trials(tmp_path / "trials")
    (out / "truth_uncertainty.json").write_text(json.dumps(told), encoding="utf-8")
    capsys.readouterr()
    assert main(["beads-table", str(tmp_path / "trials")]) == 0
    printed = capsys.readouterr().out
    assert main(["tables", str(tmp_path / "trials")]) == 0  # the same table, from what the other command has written
    assert [line for line in printed.splitlines() if "mm" in line][:3] == [
        line for line in capsys.readouterr().out.splitlines() if "mm" in line
    ][:3]
    rows = list(csv.DictReader((tmp_path / "trials" / "tables" / "trials.csv").open(encoding="utf-8")))
    assert {row["trial"] for row in rows} == {"I"}
    entry, *_ = rows
    assert float(entry["value"]) == pytest.approx(0, abs=1e-6)
    assert float(entry["beads_alone"]) == pytest.approx(trial.truth["entry_point_mm"])


def test_an_annotated_shadow_that_fits_no_bead_of_its_name_is_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_landmarks(folder / "bone.mrk.json", {f"f{n}": point for n, point in enumerate(BONE)})
    lines = ["image,bead,column_px,row_px"]
    for view in range(2):
        for kind, names in (("plain", ("femur",)), ("tool", ("femur", "device"))):
            for name in names:
                beads = {"femur": BONE, "device": TOOL}[name]
                pixels = project_points(CAMERA, transform_points(TRUE.camera_from(name)[view], beads))
                for n, (column, row) in enumerate(pixels.tolist()):
                    off = 40 if (view, kind, name, n) == (0, "tool", "device", 2) else 0
                    bead = f"{'f' if name == 'femur' else 't'}{n}"
                    lines.append(f"v{view + 1}_{kind}.tif,{bead},{column + off:.2f},{row:.2f}")
    (folder / "shadows.csv").write_text("\n".join(lines), encoding="utf-8")
    (folder / "beads.yaml").write_text(
        "objects:\n  femur: {points: bone.mrk.json, diameter_mm: 2}\n"
        "  device: {points: tool.mrk.json, diameter_mm: 2}\nannotations: shadows.csv\n",
        encoding="utf-8",
    )
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(tmp_path / "I")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "beads of device in v1_tool.tif: left out, as the others put them elsewhere: t2 (40 pixels off)" in printed
    (note,) = read_json(tmp_path / "I" / "truth_uncertainty.json")["notes"]
    assert "t2" in note


def test_fractions_are_not_rounded_away_where_beads_are_taken_out(folder: Path, tmp_path: Path) -> None:
    """Any scale of raw images will do, as that of images from 0 to 1."""
    for path in folder.glob("v?_*.tif"):
        tifffile.imwrite(path, read_image(path).numpy() / 65535)
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(tmp_path / "out")]) == 0
    for path in folder.glob("v?_*.tif"):
        cleaned = tmp_path / "out" / f"view{path.name[1:]}"
        before, after = attenuation_image(read_image(path)), attenuation_image(read_image(cleaned))
        assert ((before - after).abs() < 0.01).float().mean() > 0.95  # all but the beads


def test_logarithms_by_a_header_are_not_written_as_intensities_without_beads(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (folder / "case.yaml").read_text(encoding="utf-8")
    for path in folder.glob("v?_*.tif"):
        logarithms = (3000 - 800 * attenuation_image(read_image(path))).round().clamp(0, 4095).numpy()
        _write_logarithms(path.with_suffix(".dcm"), logarithms.astype(np.uint16))
    (folder / "case.yaml").write_text(text.replace(".tif", ".dcm"), encoding="utf-8")
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(tmp_path / "out")]) == 2
    assert "raw images of 16 bits are written without beads" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def _write_logarithms(path: Path, pixels: np.ndarray) -> None:
    """A DICOM image whose header says that it holds logarithms."""
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset.SOPClassUID = dataset.file_meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    dataset.Modality, dataset.PixelIntensityRelationship = "XA", "LOG"
    dataset.Rows, dataset.Columns = pixels.shape
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit, dataset.PixelRepresentation = 16, 12, 11, 0
    dataset.PixelData = pixels.tobytes()
    dataset.save_as(path, enforce_file_format=True)


@pytest.mark.parametrize(
    ("yaml_text", "told"),
    [
        ("objects: {device: {points: tool.mrk.json, diameter_mm: 0.002}}\n", "in mm"),
        ("objects: {femur: {points: ct, count: 9, diameter_mm: 2}}\n", "5 beads of 2 mm found, 9"),
        ("objects: {device: {points: ct, count: 5, diameter_mm: 2}}\n", "device is no bone of the CT"),
    ],
)
def test_bad_input_ends_with_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], yaml_text: str, told: str
) -> None:
    (folder / "bad.yaml").write_text(yaml_text, encoding="utf-8")
    assert main(["beads", str(folder), "--beads", str(folder / "bad.yaml"), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_images_of_two_kinds_may_have_one_name(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each kind in a folder of its own; the tool's shadows are measured again beside its edges, where it is seen.

    A result that is there already is told to be of another case.
    """
    content = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    for number, view in enumerate(content["views"], 1):
        for kind, name in view["images"].items():
            (folder / kind).mkdir(exist_ok=True)
            (folder / name).rename(folder / kind / f"{number}.tif")
            view["images"][kind] = f"{kind}/{number}.tif"
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    out = tmp_path / "out"
    (out / "run").mkdir(parents=True)
    (out / "run" / "result.json").write_text("{}", encoding="utf-8")
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(out)]) == 0
    assert read_json(out / "truth_uncertainty.json")["deviations"]["device"]["mm"] < 0.3  # 0.7 by the other images
    assert "is of the case that was here before: register again" in " ".join(capsys.readouterr().out.split())


def test_pixels_that_make_ellipses_of_beads_are_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With pixels of 0.25 × 0.2 mm one of three beads was found, and the others told to be missing."""
    content = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    content["carm"]["pixel_mm"] = [0.35, 0.28]
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    out = tmp_path / "trials" / "I"
    assert main(["beads", str(folder), "--beads", str(folder / "beads.yaml"), "--out", str(out)]) == 2
    assert "case.yaml, carm: its pixels are 0.35 × 0.28 mm. Shadows of beads are taken" in capsys.readouterr().err
    assert not out.exists()


def test_the_case_itself_is_not_written_and_is_told_before_it_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "case").mkdir()
    assert main(["beads", str(tmp_path / "case"), "--beads", "none.yaml", "--out", str(tmp_path / "case")]) == 2
    assert "is the folder that is read. Choose another one" in capsys.readouterr().err


def test_a_folder_without_trials_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["beads-table", str(tmp_path)]) == 2
    assert "femoreg beads CASE" in capsys.readouterr().err
