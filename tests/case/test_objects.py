"""Cases whose objects are written out: any bones, any models, any starts, fixed C-arm poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from femoreg_torch.case import read_case, write_case
from femoreg_torch.errors import InputError

EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]
TURNED = [[0, 0, 1, -600], [0, 1, 0, 0], [-1, 0, 0, 600], [0, 0, 0, 1]]
CASE: dict[str, Any] = {
    "version": 2,
    "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": {"tibia": 3, "fibula": [4, 9]}},
    "landmarks": "landmarks.json",
    "objects": {
        "shank": {"bones": ["tibia", "fibula"], "start": "landmarks"},
        "tibia": {"bones": "tibia", "reference": "knee", "start": {"beside": "shank"}},
        "wire": {
            "model": "wire.stl",
            "hu": 9000,
            "points": {"tip": [0, 0, 90], "base": [0, 0, 0]},
            "reference": "tip",
            "images": "wire",
            "start": {"camera1_from": EYE},
        },
        "clamp": {
            "volume": "clamp.nrrd",
            "labels": [2],
            "hu": 3000,
            "images": ["wire"],
            "start": {"beside": "wire", "beside_from_object": TURNED},
        },
    },
    "plan": {"object": "tibia", "entry_point": [1, 2, 3], "target": "knee", "tool": "wire"},
    "carm": {"sdd_mm": 1100, "pixel_mm": [0.3, 0.3], "shape": [1024, 1024]},
    "views": [
        {"images": {"plain": "a.tif", "wire": "a_wire.tif"}},
        {"images": {"plain": "b.tif", "wire": "b_wire.tif"}, "camera_from_camera1": TURNED},
    ],
}


def write(folder: Path, content: dict[str, Any]) -> Path:
    for name in ("ct.nii.gz", "labels.nii.gz", "wire.stl", "clamp.nrrd", "a.tif", "a_wire.tif", "b.tif", "b_wire.tif"):
        (folder / name).write_bytes(b"some")
    points = {"space": "RAS", "unit": "mm", "landmarks": {"knee": [1, 2, 50], "ankle": [0, 0, -300]}}
    (folder / "landmarks.json").write_text(json.dumps(points), encoding="utf-8")
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return folder


def test_objects_are_read_as_they_stand(tmp_path: Path) -> None:
    case = read_case(write(tmp_path, CASE))
    assert list(case.objects) == ["shank", "tibia", "wire", "clamp"]
    assert case.objects["shank"].start.by_landmarks
    assert case.objects["tibia"].reference is not None
    assert case.objects["tibia"].reference.tolist() == [-1, -2, 50]  # RAS to LPS
    assert case.objects["tibia"].start.beside == "shank"
    assert case.objects["clamp"].start.beside_from_object.tolist() == TURNED
    assert case.objects["clamp"].model is not None
    assert case.objects["clamp"].model.labels == (2,)
    assert case.bones == {"tibia": (3,), "fibula": (4, 9)}
    assert case.kinds == ("plain", "wire")
    assert case.views[0].camera_from_camera1 is None
    assert case.views[1].camera_from_camera1 is not None
    assert case.plan is not None
    assert case.plan.target.tolist() == [-1, -2, 50]


def test_a_written_case_of_objects_says_the_same(tmp_path: Path) -> None:
    write_case(tmp_path, read_case(write(tmp_path, CASE)))
    first = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))
    write_case(tmp_path, read_case(tmp_path))
    assert yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8")) == first
    assert first["objects"]["tibia"]["start"] == {"beside": "shank"}
    assert first["objects"]["clamp"]["start"]["beside_from_object"] == TURNED
    assert first["views"][1]["images"] == {"plain": "b.tif", "wire": "b_wire.tif"}


def test_one_kind_of_images_needs_no_name(tmp_path: Path) -> None:
    objects = {"wire": CASE["objects"]["wire"] | {"images": "image"}}
    content = {k: v for k, v in CASE.items() if k not in ("ct", "landmarks", "plan")}
    case = read_case(write(tmp_path, content | {"objects": objects, "views": [{"image": "a.tif"}]}))
    assert case.kinds == ("image",)
    write_case(tmp_path, case)
    assert yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))["views"] == [{"image": "a.tif"}]


BAD: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda c: c.update(side="left"), r"case\.yaml, .*side: unknown key"),
    (lambda c: c.update(objects={}), r"objects: is empty"),
    (lambda c: c["objects"]["shank"].update(bones="femur"), r"objects\.shank\.bones: `ct\.bones` has no 'femur'"),
    (
        lambda c: c["objects"]["shank"].update(model="wire.stl"),
        r"objects\.shank: either `bones` of the CT or a `model`",
    ),
    (lambda c: c["objects"]["shank"].pop("start"), r"objects\.shank\.start: is missing"),
    (lambda c: c["objects"]["shank"].update(start="somewhere"), r"objects\.shank\.start: a mapping"),
    (lambda c: c["objects"]["tibia"].update(start={"beside": "foot"}), r"tibia\.start\.beside: the name of another"),
    (lambda c: c["objects"]["tibia"].update(start={"beside": "tibia"}), r"tibia\.start\.beside: the name of another"),
    (lambda c: c["objects"]["tibia"].update(start={}), r"tibia\.start: either `beside` or `camera1_from`"),
    (lambda c: c["objects"]["tibia"].update(reference="hip"), r"tibia\.reference: there is no point 'hip'"),
    (lambda c: c["objects"]["wire"].update(reference="knee"), r"wire\.reference: there is no point 'knee'"),
    (lambda c: c["objects"]["wire"].update(images="lateral"), r"wire\.images: no view has an image 'lateral'"),
    (lambda c: c["objects"]["wire"]["points"].pop("tip"), r"wire\.reference: there is no point 'tip'"),
    (lambda c: c["objects"].update({"my wire": c["objects"]["wire"]}), r"objects\.my wire: a name of letters"),
    (lambda c: c["objects"].update(all=c["objects"]["wire"]), r"objects\.all: a name of letters, .* other than all"),
    (lambda c: c["plan"].update(object="shin"), r"plan\.object: shank or tibia or .* found 'shin'"),
    (lambda c: c["plan"].update(tool="clamp"), r"plan\.tool: clamp needs the points `tip` and `base`"),
    (lambda c: c["views"][0].update(image="a.tif"), r"views\[0\]\.image: `images` is given too"),
    (lambda c: c["views"][1].pop("images"), r"views\[1\]\.image: is missing"),
    (lambda c: c["ct"].update(bones={"tibia": 3, "fibula": 3}), r"ct\.bones\.fibula: label 3 belongs to tibia"),
]


@pytest.mark.parametrize("n", range(len(BAD)))
def test_bad_objects(tmp_path: Path, n: int) -> None:
    change, message = BAD[n]
    content = json.loads(json.dumps(CASE))
    change(content)
    with pytest.raises(InputError, match=message) as raised:
        read_case(write(tmp_path, content))
    assert "\n" not in str(raised.value)
