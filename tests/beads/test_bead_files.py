"""`beads.yaml` and tables of shadows: what is read, and what is told of bad ones."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from bead_scenes import DEVICE, FEMUR

from femoreg_torch.beads import given as module
from femoreg_torch.beads import read_beads
from femoreg_torch.case import Case, CaseObject, View
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CArm, centred_camera
from femoreg_torch.volume import write_landmarks


@pytest.fixture
def case(tmp_path: Path) -> Case:
    views = tuple(
        View({"anatomy": tmp_path / f"view{n}.tif", "device": tmp_path / f"view{n}_device.tif"}) for n in (1, 2)
    )
    carm = CArm(centred_camera(1020.0, (0.194, 0.194), (1536, 1536)), (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
    write_landmarks(tmp_path / "femur.mrk.json", {f"f{n}": point for n, point in enumerate(FEMUR)})
    write_landmarks(tmp_path / "device.json", {f"d{n}": point for n, point in enumerate(DEVICE)})
    return Case(tmp_path, carm, {"femur": CaseObject("femur"), "device": CaseObject("device")}, views)


def written(case: Case, text: str) -> Path:
    path = case.folder / "beads.yaml"
    path.write_text(text, encoding="utf-8")
    return path


BOTH = """objects:
  femur: {points: femur.mrk.json, diameter_mm: 1}
  device: {points: device.json, diameter_mm: 1.5, noise_mm: 0}
"""
IN_CT = """objects:
  femur: {points: ct, count: 5, diameter_mm: 1}
  device: {points: device.json, diameter_mm: 1}
"""
TWICE = "objects:\n  femur: &f {points: femur.mrk.json, diameter_mm: 1}\n  device: *f\n"


def test_points_of_slicer_and_of_the_plain_format(case: Case, against_schema: Callable[[str, Any], list[str]]) -> None:
    assert not against_schema("beads", yaml.safe_load(BOTH + "image_noise_px: 0.7\nviews: first\n"))
    given = read_beads(written(case, BOTH + "image_noise_px: 0.7\nviews: first\n"), case)
    femur, device = given.beads
    torch.testing.assert_close(femur.points, FEMUR)
    torch.testing.assert_close(device.points, DEVICE)
    assert femur.names == tuple(f"f{n}" for n in range(7))
    assert (femur.deviations_mm.tolist(), device.deviations_mm.tolist()) == ([0.2] * 7, [0.0] * 5)
    assert (given.noise_px, given.first_view_only, given.marks) == (0.7, True, None)


def test_annotations_by_image_with_and_without_names(case: Case) -> None:
    (case.folder / "px.csv").write_text(
        "image,bead,column_px,row_px\nview1,f0,10.5,20\nview2_device.tif,,3,4\n", encoding="utf-8"
    )
    marks = read_beads(written(case, BOTH + "annotations: px.csv\n"), case).marks
    assert marks is not None
    assert [(mark.bead, mark.pixel) for mark in marks["view1.tif"]] == [("f0", (10.5, 20.0))]
    assert [(mark.bead, mark.pixel) for mark in marks["view2_device.tif"]] == [(None, (3.0, 4.0))]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("objects: {}\n", "objects: a mapping|objects: is empty|objects: is missing"),
        ("objects: {tibia: {points: femur.mrk.json, diameter_mm: 1}}\n", "no such object, but femur, device"),
        ("objects: {femur: {points: femur.mrk.json}}\n", "femur.diameter_mm: is missing"),
        ("objects: {femur: {points: femur.mrk.json, diameter_mm: -1}}\n", "a positive number was expected"),
        ("objects: {femur: {points: no.json, diameter_mm: 1}}\n", "no such file"),
        ("objects: {femur: {points: femur.mrk.json, diameter_mm: 1, count: 7}}\n", "goes with `points: ct` only"),
        ("objects: {femur: {points: ct, diameter_mm: 1}}\n", "count: is missing"),
        ("objects: {femur: {points: femur.mrk.json, diameter_mm: 1, colour: red}}\n", "unknown key"),
        (BOTH + "views: second\n", "all or first was expected"),
        (BOTH + "annotations: none.csv\n", "no such file"),
        (IN_CT.replace("5", "2"), "femur.count: 2 beads, at least 4 are needed"),
        (IN_CT.replace("5", "100000000"), "femur.count: a whole number from 1 to 1000"),
        (IN_CT + "views: second\n", "all or first was expected"),
        (IN_CT + "image_noise_px: -1\n", "a positive number was expected"),
        (IN_CT + "annotations: none.csv\n", "no such file"),
        (IN_CT.replace("device.json", "none.json"), "no such file"),
        (TWICE, "two beads are named 'f0'"),
        ("- a\n", "a mapping of keys and values"),
        ("objects: {femur: [\n", "cannot be read as YAML"),
    ],
)
def test_bad_files_are_told_in_one_line_before_a_ct_is_searched(
    case: Case, text: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "read_bones", lambda case: pytest.fail("the CT was read"))
    with pytest.raises(InputError, match=told) as caught:
        read_beads(written(case, text), case)
    assert "\n" not in str(caught.value)
    assert "beads.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("image,column_px,row_px\nview1,1,2\n", "a header with image, bead"),
        ("image,bead,column_px,row_px\nview9,f0,1,2\n", "line 2: the case has no image 'view9'"),
        ("image,bead,column_px,row_px\nview1,q,1,2\n", "line 2: there is no bead 'q'"),
        ("image,bead,column_px,row_px\nview1,f0,1,x\n", "line 2, row_px: a pixel of the image"),
        ("image,bead,column_px,row_px\nview1,f0,1,9999\n", "line 2, row_px: a pixel of the image"),
        ("image,bead,column_px,row_px\nview1,f0,1,2\nview1,f0,3,4\n", "line 3: bead f0 stands there twice"),
        ("", "is empty"),
    ],
)
def test_bad_annotations_are_told_with_their_line(case: Case, rows: str, told: str) -> None:
    (case.folder / "px.csv").write_text(rows, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_beads(written(case, BOTH + "annotations: px.csv\n"), case)


def test_a_missing_file_is_told(case: Case) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_beads(case.folder / "none.yaml", case)


def test_images_of_one_name_are_refused_as_marks_go_by_it(case: Case) -> None:
    view = case.views[0]
    folders = [case.folder / name for name in ("a", "b")]
    twice = replace(case, views=tuple(replace(view, images={"anatomy": at / "img.tif"}) for at in folders))
    (case.folder / "px.csv").write_text("image,bead,column_px,row_px\nimg.tif,,1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"two images of the case are called 'img\.tif'"):
        read_beads(written(case, BOTH + "annotations: px.csv\n"), twice)
