"""A scene of 3D Slicer: its nodes name each other and files that exist, and the files hold what was registered."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
import torch
import trimesh

from femoreg_torch.case import (
    Case,
    CaseObject,
    Model,
    PlannedPath,
    Result,
    Start,
    View,
    result_content,
    write_case,
    write_json,
)
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.geometry import Poses, exp_se3, invert_rigid, load_carm
from femoreg_torch.neighbours.slicer import surface_of, write_scene
from femoreg_torch.neighbours.xreg import read_transform
from femoreg_torch.volume import Volume, read_mesh, write_volume

float64 = torch.float64


def pose(seed: float) -> torch.Tensor:
    return exp_se3(torch.tensor([0.1 * seed, -0.2, 0.3 * seed, 5 * seed, -7, 600], dtype=float64))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    for name, size in (("block", (12, 9, 7)), ("rod", (5, 5, 30))):
        trimesh.creation.box(size).export(tmp_path / f"{name}.stl")
    point = {name: torch.tensor([0.0, 0, z], dtype=float64) for name, z in (("base", -15), ("tip", 15))}
    objects = {
        "block": CaseObject("block", model=Model(tmp_path / "block.stl", 500.0), start=Start(pose(1))),
        "rod": CaseObject("rod", model=Model(tmp_path / "rod.stl", 3000.0), points=point, start=Start(pose(2))),
    }
    plan = PlannedPath(
        "block", torch.tensor([1.0, 2, 3], dtype=float64), torch.tensor([0.0, 0, 0], dtype=float64), "rod"
    )
    case = Case(tmp_path, load_carm("cios_fusion"), objects, plan=plan)
    poses = Poses(torch.eye(4, dtype=float64)[None], {"block": pose(1), "rod": pose(2)})
    result = Result(poses, {})
    (tmp_path / "slicer").mkdir()
    names = write_scene(tmp_path / "slicer", case, result)
    assert sorted(names) == sorted(path.name for path in (tmp_path / "slicer").iterdir())
    return tmp_path / "slicer"


def test_nodes_and_files(scene: Path) -> None:
    root = ElementTree.parse(scene / "scene.mrml").getroot()
    nodes = {node.get("id"): node for node in root}
    assert len(nodes) == len(root)
    for node in root:
        for key in ("storageNodeRef", "displayNodeRef", "transformNodeRef"):
            assert node.get(key) is None or node.get(key) in nodes
        assert node.get("fileName") is None or (scene / node.get("fileName", "")).is_file()
    below = {node.get("name"): node.get("transformNodeRef") for node in root if "storageNodeRef" in node.attrib}
    (transform,) = (node.get("id") for node in root if node.tag == "LinearTransform")
    assert below == {
        "block": None, "path": None, "rod": transform, "guide": transform, "block_from_rod": None
    }  # fmt: skip


def test_what_the_files_hold(scene: Path) -> None:
    # ITK's direction: takes points of the parent to those of what hangs below
    expected = invert_rigid(pose(2)) @ pose(1)
    torch.testing.assert_close(read_transform(scene / "block_from_rod.tfm"), expected, atol=1e-6, rtol=0)
    for name, size in (("block", (12, 9, 7)), ("rod", (5, 5, 30))):
        assert b"SPACE=LPS" in (scene / f"{name}.stl").read_bytes()[:80]
        mesh = read_mesh(scene / f"{name}.stl")
        np.testing.assert_allclose(mesh.bounds, np.array([-0.5, 0.5])[:, None] * size, atol=0.35)
        assert mesh.volume > 0.85 * np.prod(size)  # its faces look outwards
    (line,) = read_json(scene / "guide.mrk.json")["markups"]
    assert line["coordinateSystem"] == "LPS"
    assert [point["position"] for point in line["controlPoints"]] == [[0, 0, -15], [0, 0, 15]]


def placed_nodes(folder: Path) -> dict[str, torch.Tensor | None]:
    """How every node of a scene that hangs below nothing, or below one transform, is placed: scene from its space."""
    root = ElementTree.parse(folder / "scene.mrml").getroot()
    files = {node.get("id"): f"{node.get('name')}.tfm" for node in root if node.tag == "LinearTransform"}
    return {
        str(node.get("name")): None
        if (below := node.get("transformNodeRef")) is None
        else invert_rigid(read_transform(folder / files[below]))
        for node in root
        if node.tag in ("Volume", "Model", "MarkupsFiducial", "MarkupsLine")
    }


def case_with_a_probe_first(folder: Path, bone: bool) -> tuple[Case, Result]:
    """A probe, and after it a bone of a CT or another model, all with start poses of their own."""
    affine = torch.diag(torch.tensor([2.0, 2, 2, 1], dtype=float64))
    affine[:3, 3] = torch.tensor([-40.0, -30, 500], dtype=float64)
    labels = torch.zeros(30, 30, 30, dtype=torch.uint8)
    labels[10:20, 12:22, 8:25] = 5
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    write_volume(folder / "ct.nii.gz", Volume((1900 * (labels > 0) - 1000).to(torch.int16), affine))
    for name in ("probe", "plate"):
        trimesh.creation.box((5, 5, 30)).export(folder / f"{name}.stl")
    objects = {"probe": CaseObject("probe", model=Model(folder / "probe.stl", 5000.0), start=Start(pose(1)))}
    if bone:
        objects["femur"] = CaseObject("femur", bones=("femur_left",), start=Start(pose(2)))
    else:
        objects["plate"] = CaseObject("plate", model=Model(folder / "plate.stl", 5000.0), start=Start(pose(2)))
    case = Case(
        folder,
        load_carm("cios_fusion"),
        objects,
        (View({"image": folder / "view1.tif"}),),
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        bones={"femur_left": (5,)},
        landmarks={"FH-l": torch.tensor([0.0, 10, 540], dtype=float64)},
    )
    return case, Result(Poses(torch.eye(4, dtype=float64)[None], {n: pose(k) for k, n in enumerate(objects, 1)}), {})


def test_a_model_that_comes_first_does_not_take_the_ct_into_its_own_space(tmp_path: Path) -> None:
    case, result = case_with_a_probe_first(tmp_path, bone=True)
    (tmp_path / "slicer").mkdir()
    write_scene(tmp_path / "slicer", case, result)
    placed = placed_nodes(tmp_path / "slicer")
    probe = placed.pop("probe")
    assert placed == {"CT": None, "landmarks": None, "femur": None}
    assert probe is not None
    torch.testing.assert_close(probe, invert_rigid(pose(2)) @ pose(1), atol=1e-6, rtol=0)


def test_ct_and_landmarks_are_left_out_where_nothing_lies_in_their_space(tmp_path: Path) -> None:
    case, result = case_with_a_probe_first(tmp_path, bone=False)
    (tmp_path / "slicer").mkdir()
    names = write_scene(tmp_path / "slicer", case, result)
    assert placed_nodes(tmp_path / "slicer").keys() == {"probe", "plate"}
    assert "landmarks.mrk.json" not in names
    # what landmarks place, a surface cut out of the CT say, lies in the CT's space whatever it is made of
    plate = replace(case.objects["plate"], start=Start())
    placed = replace(case, objects=case.objects | {"plate": plate})
    write_scene(tmp_path / "slicer", placed, result)
    assert placed_nodes(tmp_path / "slicer").keys() == {"CT", "landmarks", "probe", "plate"}
    assert placed_nodes(tmp_path / "slicer")["plate"] is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_surface_lies_where_its_mask_does_whatever_the_axes(sign: float) -> None:
    affine = torch.diag(torch.tensor([sign, 1.0, 2.0, 1.0], dtype=float64))
    affine[:3, 3] = torch.tensor([10.0, 20, 30], dtype=float64)
    data = torch.zeros(8, 10, 12)
    data[2:6, 3:8, 4:11] = 1
    mesh = surface_of(Volume(data, affine), "box")
    middle = affine[:3, :3] @ torch.tensor([7.0, 5, 3.5], dtype=float64) + affine[:3, 3]
    np.testing.assert_allclose(mesh.bounds.mean(0), middle, atol=1e-6)
    assert mesh.volume > 0
    with pytest.raises(InputError, match="box: has no voxel"):
        surface_of(Volume(torch.zeros(3, 3, 3), affine), "box")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of a case of a block with a planned path, whose model stands in the case's folder."""
    folder = tmp_path / "case"
    folder.mkdir()
    trimesh.creation.box((12, 9, 7)).export(folder / "block.stl")
    tifffile.imwrite(folder / "view1.tif", np.zeros((8, 8), np.uint16))
    block = CaseObject("block", model=Model(folder / "block.stl", 500.0), start=Start(pose(1)))
    plan = PlannedPath("block", torch.tensor([1.0, 2, 3], dtype=float64), torch.zeros(3, dtype=float64), None)
    case = Case(folder, load_carm("cios_fusion"), {"block": block}, (View({"image": folder / "view1.tif"}),), plan=plan)
    write_case(folder, case)
    poses = Poses(torch.eye(4, dtype=float64)[None], {"block": pose(1)})
    points, directions = path_in_camera1(case, poses)
    (tmp_path / "run").mkdir()
    result = Result(poses, {}, points_camera1=points, directions_camera1=directions, case="../case")
    write_json(tmp_path / "run" / "result.json", result_content(result))
    return tmp_path / "run"


def test_what_is_left_out_of_a_scene_is_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["slicer", str(run)]) == 0
    assert capsys.readouterr().err == ""
    file = run.parent / "case" / "case.yaml"
    points = {"space": "LPS", "unit": "mm", "landmarks": {"corner": [0.0, 0, 3.5]}}
    write_json(file.with_name("landmarks.json"), points)
    file.write_text(file.read_text(encoding="utf-8") + "landmarks: landmarks.json\n", encoding="utf-8")
    assert main(["slicer", str(run)]) == 0
    assert capsys.readouterr().err.startswith("CT and landmarks are left out: no object that was registered")


def test_a_scene_is_written_beside_the_result_and_not_over_the_models_of_the_case(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case, model = run.parent / "case", (run.parent / "case" / "block.stl").read_bytes()
    assert main(["slicer", str(run)]) == 0
    assert (run / "slicer" / "scene.mrml").is_file()
    assert main(["slicer", str(run), "--out", str(case)]) == 2
    assert "is the folder that is read" in capsys.readouterr().err
    assert (case / "block.stl").read_bytes() == model


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"entry_point: [1.0": "entry_point: [5.0"}, "its entry point is another one"),
        ({"block:": "brick:", "object: block": "object: brick"}, "has an object 'block'"),
    ],
)
def test_a_scene_of_another_case_is_refused(
    changes: dict[str, str], told: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = run.parent / "case" / "case.yaml"
    text = file.read_text(encoding="utf-8")
    for old, new in changes.items():
        text = text.replace(old, new)
    file.write_text(text, encoding="utf-8")
    assert main(["slicer", str(run)]) == 2
    assert told in capsys.readouterr().err
    assert not (run / "slicer").exists()
