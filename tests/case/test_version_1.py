"""Cases of version 1, which tell structures by their label ids, stay readable."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from femoreg_torch.case import read_case, write_case
from femoreg_torch.errors import InputError

EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]
CASE: dict[str, Any] = {
    "version": 1,
    "side": "left",
    "ct": {
        "image": "ct.nii.gz",
        "labels": "labels.nii.gz",
        "structures": {"pelvis": [1, 2, 4], "femur_left": [5], "femur_right": [6]},
    },
    "landmarks": "landmarks.json",
    "plan": {"entry_point": [60, 0, -20], "target": "FH"},
    "device": {
        "model": "device.stl",
        "hu": 5000,
        "points": {"tip": [0, 0, 20], "base": [0, 0, -20], "center": [0, 0, 0]},
        "camera1_from_device": EYE,
    },
    "carm": "cios_fusion",
    "views": [{"anatomy": "view1.tif", "device": "view1_device.tif", "intensity": "raw"}],
    "truth": "truth.json",
}


def write(folder: Path, content: dict[str, Any]) -> Path:
    for name in ("ct.nii.gz", "labels.nii.gz", "device.stl", "view1.tif", "view1_device.tif"):
        (folder / name).write_bytes(b"some")
    points = {"space": "LPS", "unit": "mm", "landmarks": {"FH-l": [90, 0, 0], "FH-r": [-90, 0, 0]}}
    (folder / "landmarks.json").write_text(json.dumps(points), encoding="utf-8")
    truth = {"camera_from_pelvis": [EYE], "camera1_from_femur": EYE, "camera1_from_device": EYE}
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return folder


def test_a_case_of_version_1_is_a_femoroplasty(tmp_path: Path) -> None:
    case = read_case(write(tmp_path, CASE))
    assert list(case.objects) == ["pelvis", "femur", "device"]
    assert case.bones == {"pelvis": (1, 2, 4), "femur_left": (5,), "femur_right": (6,)}
    assert case.objects["femur"].bones == ("femur_left",)
    assert case.plan is not None
    assert (case.plan.object, case.plan.tool) == ("femur", "device")
    assert case.plan.target.tolist() == [90, 0, 0]
    assert case.kinds == ("anatomy", "device")
    assert case.truth is not None
    assert case.truth.camera1_from["femur"].tolist() == EYE


def test_written_anew_it_is_the_same_procedure(tmp_path: Path) -> None:
    case = read_case(write(tmp_path, CASE))
    write_case(tmp_path, case)
    content = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))
    assert content["version"] == 2
    again = read_case(tmp_path)
    assert again.bones == case.bones
    assert list(again.objects) == list(case.objects)


BAD: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda c: c["ct"].pop("structures"), r"ct\.structures: is missing"),
    (lambda c: c["ct"].update(bones="femoreg"), r"ct\.bones: unknown key"),
    (lambda c: c.update(template="femoroplasty"), r"template: unknown key"),
    (lambda c: c["ct"]["structures"].update(tibia=[7]), r"ct\.structures\.tibia: unknown key"),
    (lambda c: c["ct"]["structures"].pop("femur_left"), r"ct\.structures\.femur_left: is missing"),
    (lambda c: c["ct"]["structures"].update(pelvis=1), r"ct\.structures\.pelvis: a list of label ids"),
    (lambda c: c["ct"]["structures"].update(pelvis=[0]), r"ct\.structures\.pelvis: a label id above 0"),
    (lambda c: c["ct"]["structures"].update(pelvis=[1, 5]), r"structures\.femur_left: label 5 belongs to pelvis"),
]


@pytest.mark.parametrize("n", range(len(BAD)))
def test_bad_structures(tmp_path: Path, n: int) -> None:
    change, message = BAD[n]
    content = json.loads(json.dumps(CASE))
    change(content)
    with pytest.raises(InputError, match=message) as raised:
        read_case(write(tmp_path, content))
    assert "\n" not in str(raised.value)
