"""`femoreg register` on bad input: one line that says what and where, exit status 2, nothing half-written."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import trimesh
import yaml

from femoreg_torch.anatomy import HIP
from femoreg_torch.commands.main import main

SIZE = 64
POSE = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 700], [0, 0, 0, 1]]
CASE: dict[str, Any] = {
    "version": 1,
    "side": "left",
    "ct": {
        "image": "ct.nii.gz",
        "labels": "labels.nii.gz",
        "structures": {"pelvis": [1], "femur_left": [5], "femur_right": [6]},
    },
    "landmarks": "landmarks.json",
    "plan": {"entry_point": [60, 0, -20], "target": "FH"},
    "device": {
        "model": "device.stl",
        "hu": 5000,
        "points": {"tip": [0, 0, 20], "base": [0, 0, -20], "center": [0, 0, 0]},
        "camera1_from_device": POSE,
    },
    "carm": {"sdd_mm": 1020, "pixel_mm": [4.6, 4.6], "shape": [SIZE, SIZE]},
    "views": [{"anatomy": "view1.tif", "device": "view1_device.tif"}],
}


def write_grid(path: Path, values: np.ndarray[Any, Any], spacing: float = 5.0, direction: float = 1.0) -> None:
    image = sitk.GetImageFromArray(values)
    image.SetSpacing((spacing,) * 3)
    image.SetOrigin((-100.0 * direction, -60.0, -80.0))
    image.SetDirection((direction, 0, 0, 0, 1, 0, 0, 0, 1))
    sitk.WriteImage(image, str(path))


@pytest.fixture
def case(tmp_path: Path) -> Path:
    """A small but whole case: blocks of bone in a CT of 5 mm, and images of noise."""
    folder = tmp_path / "case"
    folder.mkdir()
    generator = np.random.default_rng(0)
    ct = generator.normal(40, 10, (32, 24, 40)).astype(np.int16)
    labels = np.zeros(ct.shape, np.uint8)
    labels[8:26, 6:18, 4:30], labels[2:14, 8:16, 30:38], labels[2:14, 8:16, 0:3] = 1, 5, 6
    ct[labels > 0] += 600
    ct[:, :2] = -1000  # air in front
    write_grid(folder / "ct.nii.gz", ct)
    write_grid(folder / "labels.nii.gz", labels)
    points = {name: [float(10 * i - 60), 0.0, float(5 * i - 40)] for i, name in enumerate(HIP.landmark_names)}
    points |= {"FH-l": [70.0, 0.0, -40.0], "FH-r": [-95.0, 0.0, -40.0]}  # in the femora
    text = {"space": "LPS", "unit": "mm", "landmarks": points}
    (folder / "landmarks.json").write_text(json.dumps(text), encoding="utf-8")
    trimesh.creation.box((10, 12, 40)).export(folder / "device.stl")
    for name in ("view1.tif", "view1_device.tif"):
        tifffile.imwrite(folder / name, generator.integers(3000, 9000, (SIZE, SIZE), np.uint16))
    (folder / "case.yaml").write_text(yaml.safe_dump(CASE), encoding="utf-8")
    return folder


def change_yaml(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    change(content)
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")


def no_ct(folder: Path) -> None:
    (folder / "ct.nii.gz").unlink()


def broken_ct(folder: Path) -> None:
    (folder / "ct.nii.gz").write_bytes(b"not an image")


def labels_elsewhere(folder: Path) -> None:
    write_grid(folder / "labels.nii.gz", np.ones((20, 20, 20), np.uint8), spacing=4.0)


def landmark_outside(folder: Path) -> None:
    content = json.loads((folder / "landmarks.json").read_text(encoding="utf-8"))
    content["landmarks"]["GSN-l"] = [900, 0, 0]
    (folder / "landmarks.json").write_text(json.dumps(content), encoding="utf-8")


def oblong_image(folder: Path) -> None:
    tifffile.imwrite(folder / "view1.tif", np.random.default_rng(2).integers(1, 9000, (SIZE, 48), np.uint16))


def colour_image(folder: Path) -> None:
    tifffile.imwrite(folder / "view1.tif", np.zeros((SIZE, SIZE, 3), np.uint8), photometric="rgb")


def constant_image(folder: Path) -> None:
    tifffile.imwrite(folder / "view1.tif", np.full((SIZE, SIZE), 700, np.uint16))


def scaled_pose(folder: Path) -> None:
    stretched = [[2.0 * v for v in row] for row in POSE[:3]] + [POSE[3]]
    change_yaml(folder, lambda c: c["device"].update(camera1_from_device=stretched))


def open_device(folder: Path) -> None:
    box = trimesh.creation.box((10, 12, 40))
    box.update_faces(np.arange(len(box.faces)) > 1)
    box.export(folder / "device.stl")


def absent_structure(folder: Path) -> None:
    change_yaml(folder, lambda c: c["ct"]["structures"].update(pelvis=[9]))


def no_landmarks_to_see(_folder: Path) -> None:
    """Noise shows no hip: the network must not find one."""


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (no_ct, "ct.nii.gz"),
        (broken_ct, "ct.nii.gz"),
        (labels_elsewhere, "FH-r of the femur_right lie on the pelvis"),
        (landmark_outside, "GSN-l"),
        (oblong_image, f"{SIZE} × {SIZE}"),
        (colour_image, "view1.tif"),
        (constant_image, "view1.tif"),
        (scaled_pose, "camera1_from_device"),
        (open_device, "device.stl"),
        (absent_structure, "no voxel carries the label 9, the pelvis"),
        (no_landmarks_to_see, "usable landmarks"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    spoil: Callable[[Path], None], says: str, case: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    spoil(case)
    run = tmp_path / "run"
    assert main(["register", str(case), "--out", str(run)]) == 2
    told = [line for line in capfd.readouterr().err.splitlines() if line.strip()]
    assert len(told) == 1, told
    assert told[0].startswith("femoreg: ")
    assert says in told[0]
    assert not run.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["case"]


def test_an_unknown_preset_lists_the_known_ones(case: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["register", str(case), "--out", str(case.parent / "run"), "--preset", "quickest"]) == 2
    told = capfd.readouterr().err
    assert all(name in told for name in ("derivative_free", "fast", "paper"))


def test_a_bad_calibration_of_the_robot_is_refused_before_the_work_begins(
    case: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    robot, run = case.parent / "robot.txt", case.parent / "run"
    robot.write_text("base_from_device\n1 0 0\n", encoding="utf-8")
    assert main(["register", str(case), "--out", str(run), "--robot", str(robot)]) == 2
    assert "robot.txt, line 2: four numbers" in capfd.readouterr().err
    robot.write_text("base_from_device\n1 0 0 900\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", encoding="utf-8")
    change_yaml(case, lambda c: c.pop("device"))
    assert main(["register", str(case), "--out", str(run), "--robot", str(robot)]) == 2
    assert "no tool to steer" in capfd.readouterr().err
    assert not run.exists()
