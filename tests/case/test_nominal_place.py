"""Nominal poses of a device in words, as a matrix beside the femur, and as a transform of 3D Slicer."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from femoreg_torch.case.femoroplasty_form import read_device_start
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import PlannedPath
from femoreg_torch.case.nominal import GUIDES, NominalPlace, bone_from_device
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points

ENTRY, TARGET = torch.tensor([[148.0, 5, -70], [110.0, -8, -40]], dtype=torch.float64)
PATH = PlannedPath("femur", ENTRY, TARGET)
DEVICE = {  # its guide runs along −y of its space, and it carries something towards +z
    "tip": torch.tensor([3.0, -60, 1], dtype=torch.float64),
    "base": torch.tensor([3.0, 40, 1], dtype=torch.float64),
    "center": torch.tensor([3.0, 0, 21], dtype=torch.float64),
}
DIRECTIONS = {  # LPS, of a left hip
    "from the side": (-1, 0, 0), "from the middle": (1, 0, 0), "from the front": (0, 1, 0), "from the back": (0, -1, 0),
    "from above": (0, 0, -1), "from below": (0, 0, 1),
}  # fmt: skip


def placed(place: NominalPlace, side: str = "left") -> dict[str, Tensor]:
    pose = bone_from_device(place, PATH, side, DEVICE)  # type: ignore[arg-type]
    assert torch.allclose(torch.linalg.det(pose[:3, :3]), torch.tensor(1.0, dtype=torch.float64))
    return {name: transform_points(pose, point[None])[0] for name, point in DEVICE.items()}


def test_along_the_path_with_the_carried_side_to_the_front() -> None:
    points = placed(NominalPlace(before_entry_mm=20))
    forward = (TARGET - ENTRY) / (TARGET - ENTRY).norm()
    torch.testing.assert_close(points["tip"], ENTRY - 20 * forward)
    torch.testing.assert_close(points["tip"] - points["base"], 100 * forward)
    carried = points["center"] - points["base"] - 40 * forward
    front = torch.tensor([0.0, -1, 0], dtype=torch.float64)
    across = front - (front @ forward) * forward
    torch.testing.assert_close(carried, 20 * across / across.norm())


@pytest.mark.parametrize("guide", DIRECTIONS)
def test_from_a_side_of_the_patient(guide: str) -> None:
    assert set(GUIDES) == {"along the planned path", *DIRECTIONS}
    expected = torch.tensor(DIRECTIONS[guide], dtype=torch.float64)
    points = placed(NominalPlace(guide, 30, in_front_mm=150))
    torch.testing.assert_close((points["tip"] - points["base"]) / 100, expected)
    front = torch.tensor([0.0, -150, 0], dtype=torch.float64)
    torch.testing.assert_close(points["tip"], ENTRY - 30 * expected + front)
    mirrored = -1 if "side" in guide or "middle" in guide else 1
    right = placed(NominalPlace(guide, 30), "right")
    torch.testing.assert_close((right["tip"] - right["base"]) / 100, mirrored * expected)


@pytest.mark.parametrize("turned", [-70.0, 90.0, 180.0])
def test_turned_by_the_right_hand_rule_about_base_to_tip(turned: float) -> None:
    still, points = placed(NominalPlace(before_entry_mm=5)), placed(NominalPlace(before_entry_mm=5, turned_deg=turned))
    torch.testing.assert_close(points["tip"], still["tip"])
    torch.testing.assert_close(points["base"], still["base"])
    axis = ((still["tip"] - still["base"]) / 100).numpy()
    turn = Rotation.from_rotvec(np.radians(turned) * axis).as_matrix()
    expected = still["tip"].numpy() + turn @ (still["center"] - still["tip"]).numpy()
    np.testing.assert_allclose(points["center"].numpy(), expected, atol=1e-9)


def test_a_device_of_revolution_takes_an_axis_of_its_space() -> None:
    round_one = DEVICE | {"center": DEVICE["tip"] * 0.5 + DEVICE["base"] * 0.5}
    pose = bone_from_device(NominalPlace("from the side"), PATH, "left", round_one)
    torch.testing.assert_close(pose[:3, :3] @ torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.0, -1, 0]).double())


def fields(**content: object) -> Fields:
    return Fields(dict(content), "case.yaml", "device")


@pytest.mark.parametrize("suffix", [".tfm", ".h5", ".txt", ".mat"])
def test_a_transform_of_slicer_puts_the_device_where_slicer_shows_it(tmp_path: Path, suffix: str) -> None:
    """3D Slicer writes the inverse of what it applies to models (ITK's direction), in LPS."""
    shown = sitk.AffineTransform(3)
    shown.SetMatrix(Rotation.from_euler("xyz", [20, -40, 110], degrees=True).as_matrix().ravel().tolist())
    shown.SetTranslation((130.0, -12.0, -55.0))
    path = tmp_path / f"device{suffix}"
    sitk.WriteTransform(shown.GetInverse(), str(path))
    start = read_device_start(fields(femur_from_device=path.name), tmp_path, PATH, "left", DEVICE)
    assert start.beside == "femur"
    for point in DEVICE.values():
        where = transform_points(start.beside_from_object, point[None])[0]
        np.testing.assert_allclose(where.numpy(), shown.TransformPoint(point.tolist()), atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "the nominal pose of the device was expected once"),
        (
            {"start": {}, "femur_from_device": "a.tfm"},
            "device.start: the nominal pose of the device is given 2 times, as `femur_from_device` and `start`",
        ),
        ({"start": {"guide": "upwards"}}, r"device\.start: guide: one of along the planned path, from the side"),
        ({"start": {"before": 3}}, "unknown key 'before'"),
        ({"start": {"turned_deg": "much"}}, r"device\.start: .*turned_deg"),
        ({"femur_from_device": "none.tfm"}, "no such file"),
        ({"femur_from_device": [[1, 0]]}, "a 4×4 matrix of numbers was expected"),
        ({"femur_from_device": "scaled.tfm"}, "not a rigid transform"),
        ({"femur_from_device": "text.tfm"}, "cannot be read as an ITK transform"),
    ],
)
def test_starts_that_are_none_are_told(tmp_path: Path, content: dict[str, object], message: str) -> None:
    scaled = sitk.AffineTransform(3)
    scaled.Scale(1.2)
    sitk.WriteTransform(scaled, str(tmp_path / "scaled.tfm"))
    (tmp_path / "text.tfm").write_text("not a transform", encoding="utf-8")
    with pytest.raises(InputError, match=message) as raised:
        read_device_start(fields(**content), tmp_path, PATH, "left", DEVICE)
    assert "\n" not in str(raised.value)
