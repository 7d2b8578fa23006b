"""Case folders: what is written comes back, and every field that can be wrong names its file and key."""

import json
from collections.abc import Callable
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.case import Case, Model, PlannedPath, Start, View, read_case, write_case, write_json
from femoreg_torch.case.femoroplasty import Device, device_of, femoroplasty_objects, planned, with_device
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CArm, Uncertainty, centred_camera, exp_se3, load_carm, poses_by_object

FILES = ("ct.nii.gz", "labels.nii.gz", "device.stl", "view1.tif", "view1_device.tif", "view2.tif")


def pose(seed: int) -> torch.Tensor:
    return exp_se3(torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))


def example(folder: Path) -> Case:
    """A case with two views and everything that is optional; its files are there but empty."""
    for name in FILES:
        (folder / name).write_bytes(b"some")
    points = torch.randn(19, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 100
    landmarks = dict(zip(HIP.landmark_names, points, strict=False))
    device_points = dict(zip(("tip", "base", "center", "end"), points[15:], strict=True))
    device = Device(Model(folder / "device.stl", 5000.0), device_points, Start(camera1_from=pose(1)))
    return Case(
        folder=folder,
        carm=load_carm("cios_fusion"),
        objects=femoroplasty_objects("left", landmarks["FH-l"], device),
        views=(
            View({"anatomy": folder / "view1.tif", "device": folder / "view1_device.tif"}),
            View({"anatomy": folder / "view2.tif"}, intensity="log"),
        ),
        anatomy=HIP,
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        bones=label_table("totalsegmentator_v2"),
        landmarks=landmarks,
        plan=planned(points[14], landmarks["FH-l"], device),
        truth=poses_by_object(torch.stack([pose(2), pose(3)]), "pelvis", {"femur": pose(4), "device": pose(5)}),
        template="femoroplasty",
        side="left",
    )


def assert_same(a: Any, b: Any) -> None:
    """Equal dataclasses, mappings and values, tensors to the decimals that are written."""
    if isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype == torch.float64
        torch.testing.assert_close(a, b, atol=1e-8, rtol=0)
    elif is_dataclass(a):
        for name in vars(a):
            assert_same(getattr(a, name), getattr(b, name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    else:
        assert a == b


def test_a_written_case_comes_back(tmp_path: Path) -> None:
    case = example(tmp_path)
    write_case(tmp_path, case)
    assert_same(read_case(tmp_path), case)
    content = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))
    assert content["plan"]["target"] == "FH"
    assert content["carm"] == "cios_fusion"
    assert content["views"][0] == {"anatomy": "view1.tif", "device": "view1_device.tif", "intensity": "raw"}


def test_a_case_without_what_is_optional_comes_back(tmp_path: Path) -> None:
    camera = centred_camera(1000.0, (0.3, 0.4), (800, 900))
    carm = CArm(camera, (0.0, 1.0, 600.0), (0.0, 1.0, 0.0), Uncertainty(0.5, 1.0))
    target = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    whole = example(tmp_path)
    case = replace(
        whole,
        side="right",
        carm=carm,
        objects=femoroplasty_objects("right", whole.landmarks["FH-r"], None),
        plan=PlannedPath("femur", target + 50, target),
        labels_path=None,
        bones={},
        views=(),
        truth=None,
    )
    write_case(tmp_path, case)
    assert_same(read_case(tmp_path), case)


def test_the_poses_of_a_biplane_come_back(tmp_path: Path) -> None:
    case = example(tmp_path)
    views = (case.views[0], replace(case.views[1], camera_from_camera1=pose(9)))
    write_case(tmp_path, replace(case, views=views))
    assert_same(read_case(tmp_path).views, views)


@pytest.mark.parametrize(("hu", "labels"), [(5000.0, (3, 7)), (None, None)])
def test_a_device_as_a_volume_comes_back(tmp_path: Path, hu: float | None, labels: tuple[int, ...] | None) -> None:
    case = example(tmp_path)
    (tmp_path / "device.nrrd").write_bytes(b"some")
    device = device_of(case)
    assert device is not None
    device = replace(device, model=Model(tmp_path / "device.nrrd", hu, labels))
    write_case(tmp_path, with_device(case, device))
    assert_same(device_of(read_case(tmp_path)), device)
    written = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))["device"]
    assert ("model" in written, written["volume"]) == (False, "device.nrrd")


def test_files_outside_the_folder_are_found_from_it(tmp_path: Path) -> None:
    case = example(tmp_path)
    (tmp_path / "made").mkdir()
    write_case(tmp_path / "made", case)
    assert (
        yaml.safe_load((tmp_path / "made" / "case.yaml").read_text(encoding="utf-8"))["ct"]["image"] == "../ct.nii.gz"
    )
    assert read_case(tmp_path / "made").ct_path.samefile(tmp_path / "ct.nii.gz")


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_operated_femur_follows_the_side(tmp_path: Path, side: str) -> None:
    write_case(tmp_path, example(tmp_path))
    text = (tmp_path / "case.yaml").read_text(encoding="utf-8").replace("side: left", f"side: {side}")
    (tmp_path / "case.yaml").write_text(text, encoding="utf-8")
    case = read_case(tmp_path)
    assert case.objects["femur"].bones == (f"femur_{side}",)
    head = case.objects["femur"].reference
    assert head is not None
    assert torch.equal(head, case.landmarks[f"FH-{side[0]}"])
    assert case.objects["femur"].start.beside == "pelvis"


Change = Callable[[dict[str, Any]], object]
SCALED = [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]
EYE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]]
SHIFTED = [[1.0, 0, 0, 5.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]]
MIRRORED = [[-1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]]


def as_volume(content: dict[str, Any], file: str, **change: Any) -> None:
    """Give the device as a volume instead of a mesh."""
    del content["device"]["model"]
    content["device"] |= {"volume": file} | change


BAD: list[tuple[Change, str]] = [
    (lambda c: c.update(sied="left"), r"case\.yaml, .*sied: unknown key"),
    (lambda c: c.pop("side"), r"case\.yaml, .*side: is missing, left or right"),
    (lambda c: c.update(side="both"), r"case\.yaml, .*side: left or right was expected, found 'both'"),
    (lambda c: c.update(version=3), r"case\.yaml, .*version: .* found 3"),
    (lambda c: c.update(version=True), r"case\.yaml, .*version: .* found True"),
    (lambda c: c.update(template="knee"), r"case\.yaml, .*template: femoroplasty was expected, found 'knee'"),
    (lambda c: c.pop("template"), r"case\.yaml, .*side: unknown key"),
    (lambda c: c.pop("version"), r"case\.yaml, .*version: is missing"),
    (lambda c: c.pop("ct"), r"case\.yaml, .*ct: is missing"),
    (lambda c: c.update(ct="ct.nii.gz"), r"case\.yaml, .*ct: a mapping"),
    (lambda c: c["ct"].pop("image"), r"ct\.image: is missing"),
    (lambda c: c["ct"].update(image="no.nii.gz"), r"ct\.image: 'no\.nii\.gz': no such file"),
    (lambda c: c["ct"].update(image=3), r"ct\.image: the path of a file was expected, found 3"),
    (lambda c: c["ct"].update(labels="no.nii.gz"), r"ct\.labels: .*no such file"),
    (lambda c: c["ct"].update(label="a"), r"ct\.label: unknown key"),
    (lambda c: c["ct"].pop("bones"), r"ct\.bones: missing. Name the table"),
    (lambda c: c["ct"].update(bones="totalsegmentor"), r"ct\.bones: no anatomy/labels preset .*totalsegmentator_v2"),
    (lambda c: c["ct"].update(bones=["pelvis"]), r"ct\.bones: the name of a table or .* found list"),
    (lambda c: c["ct"].update(bones={"tibia": 7}), r"ct\.bones: anatomy hip: there is no bone 'tibia'"),
    (lambda c: c["ct"].update(bones={"pelvis": 7}), r"ct\.bones: has no id of the femur_left"),
    (lambda c: c["ct"].update(bones={"pelvis": 0}), r"ct\.bones\.pelvis: a label id above 0"),
    (lambda c: c["ct"].update(bones={"pelvis": 1, "femur_left": [2, 1]}), r"femur_left: label 1 belongs to pelvis"),
    (lambda c: c.update(landmarks="no.json"), r"case\.yaml, .*landmarks: .*no such file"),
    (lambda c: c["plan"].pop("entry_point"), r"plan\.entry_point: is missing, a point"),
    (lambda c: c["plan"].update(entry_point=[1, 2]), r"plan\.entry_point: a point \[x, y, z\] in mm"),
    (lambda c: c["plan"].update(entry_point=[1, 2, float("nan")]), r"line .*: \.nan is no number"),
    (lambda c: c["plan"].update(entry_point=["a", 2, 3]), r"plan\.entry_point: a point"),
    (lambda c: c["plan"].pop("target"), r"plan\.target: is missing"),
    (lambda c: c["plan"].update(target="head"), r"plan\.target: one of FH, GSN"),
    (lambda c: c["plan"].update(target="ASIS"), r"plan\.target: landmark ASIS-l is not in the landmark file"),
    (lambda c: c["plan"].update(target=7), r"plan\.target: a point"),
    (lambda c: c["plan"].update(entry_point=[1, 2, 3], target=[1, 2, 3]), r"plan\.entry_point: is the target itself"),
    (lambda c: c["device"].pop("hu"), r"device\.hu: is missing"),
    (lambda c: c["device"].update(hu="steel"), r"device\.hu: a number was expected, found 'steel'"),
    (lambda c: c["device"].update(hu=True), r"device\.hu: a number was expected"),
    (lambda c: c["device"].update(model="no.stl"), r"device\.model: .*no such file"),
    (lambda c: c["device"].pop("model"), r"device\.model: is missing"),
    (lambda c: c["device"].update(model="labels.nii.gz"), r"device\.model: a mesh .*labels\.nii\.gz.*`volume`"),
    (lambda c: c["device"].update(volume="labels.nii.gz"), r"device\.volume: `model` \(a mesh\) is given too"),
    (lambda c: c["device"].update(labels=[1]), r"device\.labels: only a `volume` has labels"),
    (lambda c: as_volume(c, "device.stl", labels=[1]), r"device\.volume: a volume .*device\.stl.*`model`"),
    (lambda c: as_volume(c, "no.nrrd", labels=[1]), r"device\.volume: .*no such file"),
    (lambda c: as_volume(c, "labels.nii.gz", labels=[0]), r"device\.labels: a label id above 0.*found \[0\]"),
    (lambda c: as_volume(c, "labels.nii.gz", labels="all"), r"device\.labels: a label id above 0.*found 'all'"),
    (lambda c: as_volume(c, "labels.nii.gz", labels=[1], hu=None), r"device\.hu: is missing"),
    (lambda c: as_volume(c, "labels.nii.gz"), r"device\.hu: a `volume` without `labels` holds HU"),
    (lambda c: c["device"]["points"].pop("base"), r"device\.points\.base: is missing"),
    (lambda c: c["device"]["points"].update(top=[0, 0, 0]), r"device\.points\.top: unknown key"),
    (lambda c: c["device"]["points"].update(tip=c["device"]["points"]["base"]), r"points\.tip: tip and base are"),
    (lambda c: c["device"].update(camera1_from_device=SCALED), r"device\.camera1_from_device: not a rigid"),
    (lambda c: c["device"].update(camera1_from_device=MIRRORED), r"device\.camera1_from_device: a mirrored"),
    (lambda c: c["device"].update(camera1_from_device=SCALED[:3]), r"device\.camera1_from_device: a 4×4 matrix"),
    (lambda c: c["device"].update(camera1_from_device=[[1, 2], [3]]), r"device\.camera1_from_device: a 4×4 matrix"),
    (lambda c: c.update(carm="cios"), r"case\.yaml, .*carm: no carm preset 'cios'; there are: .*cios_fusion"),
    (lambda c: c.update(carm=3), r"case\.yaml, .*carm: "),
    (lambda c: c.update(carm={"sdd_mm": 1020}), r"case\.yaml, .*carm: `pixel_mm` is missing"),
    (lambda c: c.update(carm={"sdd_mm": "far", "pixel_mm": [1, 1], "shape": [9, 9]}), r"case\.yaml, .*carm\.sdd_mm: "),
    (lambda c: c.update(views="view1.tif"), r"case\.yaml, .*views: a list"),
    (lambda c: c["views"][1].update(anatomy="no.tif"), r"case\.yaml, .*views\[1\]\.anatomy: .*no such file"),
    (lambda c: c["views"][0].update(device="no.tif"), r"case\.yaml, .*views\[0\]\.device: .*no such file"),
    (lambda c: c["views"][0].update(intensity="bright"), r"case\.yaml, .*views\[0\]\.intensity: raw or log"),
    (lambda c: c["views"][0].update(image="view1.tif"), r"case\.yaml, .*views\[0\]\.image: unknown key"),
    (lambda c: c["views"][0].update(camera_from_camera1=SCALED), r"views\[0\]\.camera_from_camera1: not a rigid"),
    (lambda c: c["views"][0].update(camera_from_camera1=SHIFTED), r"camera_from_camera1: the first view is camera 1"),
    (lambda c: c["views"][0].update(camera_from_camera1=EYE), r"views\[1\]\.camera_from_camera1: missing, while"),
    (lambda c: c["views"].pop(), r"truth\.json, camera_from_pelvis: 2 poses, but the case has 1 views"),
    (lambda c: c.update(truth="no.json"), r"case\.yaml, .*truth: .*no such file"),
]  # fmt: skip


@pytest.mark.parametrize("n", range(len(BAD)))
def test_bad_fields(tmp_path: Path, n: int) -> None:
    change, message = BAD[n]
    write_case(tmp_path, example(tmp_path))
    content = yaml.safe_load((tmp_path / "case.yaml").read_text(encoding="utf-8"))
    landmarks = json.loads((tmp_path / "landmarks.json").read_text(encoding="utf-8"))
    del landmarks["landmarks"]["ASIS-l"]
    write_json(tmp_path / "landmarks.json", landmarks)
    change(content)
    (tmp_path / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    with pytest.raises(InputError, match=message) as raised:
        read_case(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "key", "value", "message"),
    [
        ("truth.json", "camera1_from_femur", SCALED, r"truth\.json, camera1_from_femur: not a rigid"),
        ("truth.json", "camera1_from_femur", None, r"truth\.json, camera1_from_femur: is missing"),
        ("truth.json", "camera1_from_device", None, r"truth\.json, camera1_from_device: is missing"),
        ("truth.json", "camera_from_pelvis", [SCALED], r"truth\.json, camera_from_pelvis\[0\]: not a rigid"),
        ("truth.json", "camera_from_pelvis", [], r"truth\.json, camera_from_pelvis: a list"),
        ("truth.json", "seed", 1, r"truth\.json, seed: unknown key"),
        ("landmarks.json", "landmarks", {"FH-r": [0, 0, 0]}, r"case\.yaml, .*landmarks: FH-l, .* is missing"),
    ],
)
def test_bad_truth_and_landmarks(tmp_path: Path, name: str, key: str, value: Any, message: str) -> None:
    write_case(tmp_path, example(tmp_path))
    write_json(tmp_path / name, json.loads((tmp_path / name).read_text(encoding="utf-8")) | {key: value})
    with pytest.raises(InputError, match=message):
        read_case(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "not a case folder"),
        (b"- a\n- b\n", "a mapping"),
        (b"a: [1", "cannot be read as YAML"),
        (b"\xff\xfe\x00\x80", "cannot be read as YAML"),
    ],
)
def test_what_is_no_case(tmp_path: Path, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / "case.yaml").write_bytes(content)
    with pytest.raises(InputError, match=message) as raised:
        read_case(tmp_path)
    assert "\n" not in str(raised.value)
