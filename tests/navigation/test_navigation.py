"""Navigation: the correction against arithmetic with plain numpy, files read back by SimpleITK, bad calibrations."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from femoreg_torch.case import Result, read_result
from femoreg_torch.commands.main import main
from femoreg_torch.files import read_json, write_json
from femoreg_torch.geometry import poses_by_object
from femoreg_torch.intake import inspect_path
from femoreg_torch.navigation import navigation_content, read_robot, summary

Matrix = NDArray[np.float64]


def pose(seed: int, distance: float = 300.0) -> Matrix:
    generator = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(rng=generator).as_matrix()
    matrix[:3, 3] = generator.normal(size=3) * distance
    return matrix


def apply(b_from_a: Matrix, point: Any) -> Matrix:
    return b_from_a[:3, :3] @ np.asarray(point) + b_from_a[:3, 3]


CAMERA1_FROM_FEMUR, CAMERA1_FROM_DEVICE = pose(1), pose(2)
ENTRY, TARGET = np.array([60.0, -12, 30]), np.array([95.0, -3, 41])  # femur (CT, LPS)
TIP, BASE = np.array([1.0, 2, 100]), np.array([0.5, -2, 3])  # device (CAD)
FLANGE_FROM_DEVICE, BASE_FROM_FLANGE = pose(3, 60), pose(4, 500)


def write_run(folder: Path, trusted: bool = True, device: bool = True) -> Path:
    """A result.json as the registration writes it, made from the literals above."""
    path, guide = TARGET - ENTRY, TIP - BASE
    result: dict[str, Any] = {
        "version": 1,
        "camera_from_pelvis": np.stack([CAMERA1_FROM_FEMUR] * 3),
        "camera1_from_femur": CAMERA1_FROM_FEMUR,
        "points_camera1": {"entry_point": apply(CAMERA1_FROM_FEMUR, ENTRY)},
        "directions_camera1": {"path": CAMERA1_FROM_FEMUR[:3, :3] @ path / np.linalg.norm(path)},
        "quality": {
            "pelvis": {"trusted": True, "reason": "all views agree"},
            "femur": {"trusted": trusted, "reason": "view 2 would move the femur by (3.0, 0.1) mm"},
            **({"device": {"trusted": True, "reason": "all views agree"}} if device else {}),
        },
        "trusted": trusted,
    }
    if device:
        result["camera1_from_device"] = CAMERA1_FROM_DEVICE
        result["femur_from_device"] = np.linalg.inv(CAMERA1_FROM_FEMUR) @ CAMERA1_FROM_DEVICE
        result["points_camera1"]["tip"] = apply(CAMERA1_FROM_DEVICE, TIP)
        result["directions_camera1"]["guide"] = CAMERA1_FROM_DEVICE[:3, :3] @ guide / np.linalg.norm(guide)
    folder.mkdir(exist_ok=True)
    write_json(folder / "result.json", result)
    return folder


def rows(matrix: Matrix) -> str:
    return "\n".join(" ".join(repr(float(v)) for v in row) for row in matrix)


def write_flange(path: Path) -> Path:
    path.write_text(
        f"""# robot A
base_from_flange   # forward kinematics, mm
{rows(BASE_FROM_FLANGE)}

flange_from_device
{rows(FLANGE_FROM_DEVICE).replace(" ", ", ")}
""",
        encoding="utf-8",
    )
    return path


def test_a_run_whose_case_is_gone_is_told_that_its_plan_was_not_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    write_json(run / "result.json", read_json(run / "result.json") | {"case": "../archived"})
    assert main(["navigate", str(run)]) == 0
    told = "".join(capsys.readouterr().out.split())  # a long path is wrapped anywhere
    assert "Whethertheplanwaschangedsincewasnotasked:" in told
    assert "archived" in told
    assert (run / "navigation.json").is_file()


def test_what_is_written_fits_its_schema(tmp_path: Path, against_schema: Callable[[str, Any], list[str]]) -> None:
    run, content = navigated(tmp_path)
    assert not against_schema("navigation", content)
    assert against_schema("navigation", content | {"unknown": 1})
    assert against_schema("navigation", content | {"femur_from_device": [[1.0]]})
    assert main(["navigate", str(run)]) == 0  # without a robot
    assert not against_schema("navigation", json.loads((run / "navigation.json").read_text(encoding="utf-8")))


def navigated(tmp_path: Path, **settings: bool) -> tuple[Path, dict[str, Any]]:
    run = write_run(tmp_path / "run", **settings)
    assert main(["navigate", str(run), "--robot", str(write_flange(tmp_path / "robot.txt"))]) == 0
    return run, json.loads((run / "navigation.json").read_text(encoding="utf-8"))


def test_the_corrected_device_has_its_guide_on_the_path_and_its_tip_at_the_entry_point(tmp_path: Path) -> None:
    content = navigated(tmp_path)[1]
    corrected = np.array(content["femur_from_device"]) @ np.array(content["correction_in_device"])
    np.testing.assert_allclose(apply(corrected, TIP), ENTRY, atol=1e-6)
    guide, path = apply(corrected, TIP) - apply(corrected, BASE), TARGET - ENTRY
    np.testing.assert_allclose(guide / np.linalg.norm(guide), path / np.linalg.norm(path), atol=1e-8)


def test_offset_and_angle_are_those_of_the_uncorrected_device(tmp_path: Path) -> None:
    content = navigated(tmp_path)[1]
    femur_from_device = np.linalg.inv(CAMERA1_FROM_FEMUR) @ CAMERA1_FROM_DEVICE
    np.testing.assert_allclose(content["femur_from_device"], femur_from_device, atol=1e-8)
    offset = apply(femur_from_device, TIP) - ENTRY
    np.testing.assert_allclose(content["in_femur"]["tip_offset"], offset, atol=1e-6)
    np.testing.assert_allclose(content["in_device"]["tip_offset"], femur_from_device[:3, :3].T @ offset, atol=1e-6)
    np.testing.assert_allclose(content["in_device"]["tip"], TIP, atol=1e-6)
    assert content["tip_offset_mm"] == pytest.approx(np.linalg.norm(offset))
    guide, path = femur_from_device[:3, :3] @ (TIP - BASE), TARGET - ENTRY
    cosine = guide @ path / np.linalg.norm(guide) / np.linalg.norm(path)
    assert content["angle_deg"] == pytest.approx(np.degrees(np.arccos(cosine)))
    assert content["correction_deg"] == pytest.approx(content["angle_deg"], abs=1e-6)


def test_no_turn_about_the_guide_makes_the_correction_smaller(tmp_path: Path) -> None:
    correction = Rotation.from_matrix(np.array(navigated(tmp_path)[1]["correction_in_device"])[:3, :3])
    axis = (TIP - BASE) / np.linalg.norm(TIP - BASE)
    for turn in np.radians([-170, -40, -1, 1, 40, 170]):
        assert (correction * Rotation.from_rotvec(turn * axis)).magnitude() > correction.magnitude()


def test_the_robots_flange_carries_the_device_onto_the_path(tmp_path: Path) -> None:
    """The patient stands still in the robot's base; moving the flange alone must bring the guide there."""
    content = navigated(tmp_path)[1]
    before = BASE_FROM_FLANGE @ FLANGE_FROM_DEVICE
    base_from_femur = before @ np.linalg.inv(CAMERA1_FROM_DEVICE) @ CAMERA1_FROM_FEMUR
    np.testing.assert_allclose(content["base_from_femur"], base_from_femur, atol=1e-6)
    after = np.array(content["base_from_corrected_flange"]) @ FLANGE_FROM_DEVICE
    np.testing.assert_allclose(apply(after, TIP), apply(base_from_femur, ENTRY), atol=1e-5)
    np.testing.assert_allclose(after, content["base_from_corrected_device"], atol=1e-6)
    np.testing.assert_allclose(after, np.array(content["correction_in_base"]) @ before, atol=1e-5)
    guide = (after[:3, :3] @ (TIP - BASE)) / np.linalg.norm(TIP - BASE)
    path = (base_from_femur[:3, :3] @ (TARGET - ENTRY)) / np.linalg.norm(TARGET - ENTRY)
    np.testing.assert_allclose(guide, path, atol=1e-8)
    np.testing.assert_allclose(content["in_base"]["entry_point"], apply(base_from_femur, ENTRY), atol=1e-6)


def registered(entry_point: list[float], tip: list[float], path: list[float], guide: list[float]) -> Result:
    """A result in which camera 1, femur and device have one frame."""
    eye = torch.eye(4, dtype=torch.float64)
    numbers = {"entry_point": entry_point, "tip": tip, "path": path, "guide": guide}
    vectors = {name: torch.tensor(value, dtype=torch.float64) for name, value in numbers.items()}
    return Result(
        poses_by_object(eye[None], "pelvis", {"femur": eye, "device": eye}),
        quality={},
        path=("femur", "device"),
        points_camera1={name: vectors[name] for name in ("entry_point", "tip")},
        directions_camera1={name: vectors[name] for name in ("path", "guide")},
    )


def test_a_known_case() -> None:
    """Guide along z, path along x, entry point 10 mm beyond the tip: a quarter turn about y, and tip to (0, 0, 110)."""
    content = navigation_content(registered([0, 0, 110], [0, 0, 100], [1, 0, 0], [0, 0, 1]), None)
    expected = torch.tensor([[0, 0, 1, -100], [0, 1, 0, 0], [-1, 0, 0, 110], [0, 0, 0, 1]]).double()
    torch.testing.assert_close(content["correction_in_device"], expected)
    assert content["angle_deg"] == pytest.approx(90)
    assert content["in_device"]["tip_offset"].tolist() == pytest.approx([0, 0, -10])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_guide_along_the_path_or_against_it(sign: float) -> None:
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    point = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    result = registered(point.tolist(), point.tolist(), (sign * axis).tolist(), axis.tolist())
    correction = navigation_content(result, None)["correction_in_device"]
    torch.testing.assert_close(correction[:3, :3] @ axis, sign * axis)
    torch.testing.assert_close(correction[:3, :3] @ point + correction[:3, 3], point)
    assert torch.linalg.det(correction).item() == pytest.approx(1)


def test_files_are_read_back_by_simpleitk_and_numpy(tmp_path: Path) -> None:
    """ITK's direction: a transform named b_from_a takes points of b to a, so that an image in a is resampled into b."""
    run, content = navigated(tmp_path)
    names = {path.stem for path in (run / "navigation").iterdir()}
    assert names == {
        "base_from_corrected_device",
        "base_from_corrected_flange",
        "base_from_femur",
        "correction_in_base",
        "correction_in_device",
        "femur_from_device",
    }
    for name in names:
        matrix = np.array(content[name])
        np.testing.assert_allclose(np.loadtxt(run / "navigation" / f"{name}.txt"), matrix, atol=1e-8)
        transform = sitk.ReadTransform(str(run / "navigation" / f"{name}.tfm"))
        for point in ([0.0, 0, 0], [12.0, -7, 30]):
            np.testing.assert_allclose(transform.TransformPoint(apply(matrix, point).tolist()), point, atol=1e-6)


def test_the_transform_resamples_the_device_to_where_it_is_in_the_ct(tmp_path: Path) -> None:
    """A bright voxel of an image in the device's frame appears at `femur_from_device` of its place."""
    run, content = navigated(tmp_path)
    image = sitk.Image(21, 21, 21, sitk.sitkFloat32)
    image.SetOrigin((-9.0, -8.0, 90.0))  # voxel 10, 10, 10 is the tip
    image[10, 10, 10] = 1.0
    there = apply(np.array(content["femur_from_device"]), TIP)
    grid = sitk.Image(31, 31, 31, sitk.sitkFloat32)
    grid.SetOrigin((there - 15).tolist())
    transform = sitk.ReadTransform(str(run / "navigation" / "femur_from_device.tfm"))
    moved = sitk.GetArrayFromImage(sitk.Resample(image, grid, transform, sitk.sitkLinear, 0.0))
    assert np.unravel_index(moved.argmax(), moved.shape) == (15, 15, 15)
    assert moved.max() > 0.9


def test_a_result_without_trust_says_so_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, content = navigated(tmp_path, trusted=False)
    assert content["trusted"] is False
    assert content["reasons"] == ["femur: view 2 would move the femur by (3.0, 0.1) mm"]
    for path in (run / "navigation").iterdir():
        assert "NOT TRUSTED: femur: view 2 would move" in path.read_text(encoding="utf-8"), path
    assert "Do not steer by this" in capsys.readouterr().out
    trusted_run, content = navigated(tmp_path, trusted=True)
    assert content["trusted"] is True
    for path in (trusted_run / "navigation").iterdir():
        assert "NOT TRUSTED" not in path.read_text(encoding="utf-8"), path
    assert "Do not steer" not in capsys.readouterr().out


def test_of_a_round_device_no_direction_in_its_frame_is_trusted(tmp_path: Path) -> None:
    """Registered with another turn, the same needle would be told another way to go in the robot's base."""
    run = write_run(tmp_path / "run")
    written = json.loads((run / "result.json").read_text(encoding="utf-8"))
    written["quality"]["device"]["turn_told"] = False
    (run / "result.json").write_text(json.dumps(written), encoding="utf-8")
    assert main(["navigate", str(run)]) == 0
    content = json.loads((run / "navigation.json").read_text(encoding="utf-8"))
    assert content["trusted"] is False
    assert content["turn_told"] is False
    assert "turn of the device" in content["reasons"][0]
    assert "NOT TRUSTED: no image tells the turn of the device" in (
        run / "navigation" / "correction_in_device.txt"
    ).read_text("utf-8")


@pytest.mark.parametrize("trusted", [True, False])
def test_what_is_told_in_the_femurs_frame_holds_of_a_trusted_result_alone(trusted: bool, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", trusted=trusted)
    written = json.loads((run / "result.json").read_text(encoding="utf-8"))
    written["quality"]["device"]["turn_told"] = False
    (run / "result.json").write_text(json.dumps(written), encoding="utf-8")
    assert main(["navigate", str(run)]) == 0
    reasons = json.loads((run / "navigation.json").read_text(encoding="utf-8"))["reasons"]
    assert len(reasons) == 1 + (not trusted)
    assert reasons[-1].endswith("those in the frame of the femur hold") == trusted


def test_a_result_that_does_not_speak_of_trust_has_none(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    content = json.loads((run / "result.json").read_text(encoding="utf-8"))
    del content["quality"], content["trusted"]
    (run / "result.json").write_text(json.dumps(content), encoding="utf-8")
    assert main(["navigate", str(run)]) == 0
    assert json.loads((run / "navigation.json").read_text(encoding="utf-8"))["trusted"] is False


def test_a_new_navigation_leaves_nothing_of_the_old_one(tmp_path: Path) -> None:
    run, _ = navigated(tmp_path)
    assert main(["navigate", str(run)]) == 0
    assert "base_from_femur" not in json.loads((run / "navigation.json").read_text(encoding="utf-8"))
    assert {path.stem for path in (run / "navigation").iterdir()} == {"femur_from_device", "correction_in_device"}


def test_without_a_device_there_is_nothing_to_steer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", device=False)
    assert main(["navigate", str(run)]) == 2
    assert "no tool was registered" in capsys.readouterr().err
    assert [path.name for path in run.iterdir()] == ["result.json"]


def test_every_kind_of_calibration_file_gives_the_same(tmp_path: Path) -> None:
    expected = torch.from_numpy(BASE_FROM_FLANGE @ FLANGE_FROM_DEVICE)
    by_flange = read_robot(write_flange(tmp_path / "robot.txt"), "device")
    torch.testing.assert_close(by_flange.base_from_tool, expected)
    assert by_flange.base_from_flange is not None
    (tmp_path / "direct.txt").write_text(f"base_from_device\n{rows(expected.numpy())}", encoding="utf-8")
    (tmp_path / "base_from_device.txt").write_text(f"# bare\n{rows(expected.numpy())}", encoding="utf-8")
    transform = sitk.Euler3DTransform()
    device_from_base = np.linalg.inv(expected.numpy())
    transform.SetMatrix(device_from_base[:3, :3].flatten().tolist(), 1e-9)
    transform.SetTranslation(device_from_base[:3, 3].tolist())
    sitk.WriteTransform(transform, str(tmp_path / "base_from_device.tfm"))
    for name in ("direct.txt", "base_from_device.txt", "base_from_device.tfm"):
        found = read_robot(tmp_path / name, "device")
        torch.testing.assert_close(found.base_from_tool, expected, atol=1e-8, rtol=0)
        assert found.base_from_flange is None


def test_few_digits_do_not_leave_a_rotation_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "base_from_device.txt").write_text(rows(np.round(pose(7), 5)), encoding="utf-8")
    rotation = read_robot(tmp_path / "base_from_device.txt", "device").base_from_tool[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)


def changed(row: int, column: int, value: float) -> Matrix:
    matrix = pose(5)
    matrix[row, column] = value
    return matrix


def by_flange(base_from_flange: Matrix, flange_from_device: Matrix) -> str:
    return f"base_from_flange\n{rows(base_from_flange)}\nflange_from_device\n{rows(flange_from_device)}"


def write_scaled_tfm(path: Path) -> None:
    transform = sitk.AffineTransform(3)
    transform.Scale(1.2)
    sitk.WriteTransform(transform, str(path))


BAD: list[tuple[str, Callable[[Path], object], str]] = [
    ("missing.txt", lambda path: None, "no such file"),
    ("folder.txt", lambda path: path.mkdir(), "is a folder, a file was expected"),
    ("empty.txt", lambda path: path.write_text("# nothing\n", encoding="utf-8"), "holds no matrix"),
    ("picture.txt", lambda path: path.write_bytes(b"\x89PNG\xff\xfe\x00"), "is not text"),
    ("robot.txt", lambda path: path.write_text(rows(pose(5)), encoding="utf-8"), "holds `robot`. Expected"),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_flange\n{rows(pose(5))}", encoding="utf-8"),
        "holds `base_from_flange`. Expected",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_hand\n{rows(pose(5))}", encoding="utf-8"),
        "line 1: four numbers or the name",
    ),
    ("a.txt", lambda path: path.write_text(f"base_from_device\n{rows(pose(5)[:3])}", encoding="utf-8"), "3 rows found"),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(pose(5)[:, :3])}", encoding="utf-8"),
        "line 2: four numbers",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(changed(1, 1, np.nan))}", encoding="utf-8"),
        "not finite",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(changed(0, 3, np.inf))}", encoding="utf-8"),
        "not finite",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(pose(5) * 1.1)}", encoding="utf-8"),
        "not a rigid transform",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(pose(5).T)}", encoding="utf-8"),
        "not a rigid transform",
    ),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(pose(5) @ np.diag([1, 1, -1, 1]))}", encoding="utf-8"),
        "mirrored",
    ),
    ("a.txt", lambda path: path.write_text(f"base_from_device\n{rows(pose(5, 0.5))}", encoding="utf-8"), "in metres"),
    ("a.txt", lambda path: path.write_text(by_flange(pose(5, 0.9), pose(6, 85.0)), encoding="utf-8"), "in metres"),
    ("a.txt", lambda path: path.write_text(by_flange(pose(5, 900.0), pose(6, 0.085)), encoding="utf-8"), "in metres"),
    (
        "a.txt",
        lambda path: path.write_text(f"base_from_device\n{rows(pose(5))}\n" * 2, encoding="utf-8"),
        "stands there twice",
    ),
    ("a.tfm", lambda path: path.write_text("garbage", encoding="utf-8"), "cannot be read as an ITK transform"),
    ("base_from_device.tfm", write_scaled_tfm, "not a rigid transform"),
    ("other.tfm", lambda path: sitk.WriteTransform(sitk.Euler3DTransform(), str(path)), "holds `other`"),
]


@pytest.mark.parametrize(("name", "spoil", "says"), BAD, ids=[f"{name}: {says}" for name, _, says in BAD])
def test_a_bad_calibration_is_one_line_and_changes_nothing(
    name: str, spoil: Callable[[Path], object], says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    spoil(tmp_path / name)
    assert main(["navigate", str(run), "--robot", str(tmp_path / name)]) == 2
    told = capfd.readouterr().err
    assert told.startswith(f"femoreg: {tmp_path / name}")
    assert told.count("\n") == 1
    assert says in told
    assert [path.name for path in run.iterdir()] == ["result.json"]


def test_reasons_that_stand_above_are_not_told_twice(tmp_path: Path) -> None:
    run, _ = navigated(tmp_path, trusted=False)
    content = navigation_content(read_result(run), None)
    reason = "femur: view 2 would move the femur by (3.0, 0.1) mm"
    assert reason in summary(content)[0]
    assert summary(content, [reason])[0].endswith("Do not steer by this, it is not trusted[/].")
    assert summary(content, [reason])[1:] == summary(content)[1:]


@pytest.mark.parametrize("trusted", [True, False])
def test_inspect_tells_what_a_result_is(trusted: bool, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", trusted)
    (run / "overlay.png").write_bytes(b"a picture in colour")
    for path in (run, run / "result.json"):
        found = inspect_path(path)
        assert found.kind == "result of a registration"
        assert "objects: pelvis, femur, device; 3 views" in found.facts
        assert bool(found.warnings) != trusted
    assert inspect_path(run / "overlay.png").kind == f"part of the result in {run}"
    assert inspect_path(tmp_path).facts == ("run: result",)
