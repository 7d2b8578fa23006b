"""Round objects: found, and not asked for the turn that no image tells."""

import math
from pathlib import Path

import pytest
import torch
import trimesh
from registration_scenes import CARM
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, Model, Start, View
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import Poses, exp_so3
from femoreg_torch.registration.evidence.covariance import IntrinsicsEstimate, PoseCovariance
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.registration.quality import _Judged
from femoreg_torch.registration.roundness import Axis, round_axis
from femoreg_torch.volume import Volume, axis_aligned

AXIS = torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64) / 3
MIDDLE = torch.tensor([19.0, 18.0, 21.0], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)


def solid(shape: str) -> Volume:
    """A solid of 24 mm along a tilted axis, in voxels of 0.5 mm."""
    z, y, x = torch.meshgrid(*[0.5 * torch.arange(80, dtype=torch.float64)] * 3, indexing="ij")
    away = torch.stack([x, y, z], -1) - MIDDLE
    along = away @ AXIS
    side = torch.linalg.cross(AXIS, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    side /= side.norm()
    u, v = away @ side, away @ torch.linalg.cross(AXIS, side)
    radius, within = u.hypot(v), along.abs() < 12
    of = {
        "rod": radius < 4,
        "tube": (radius < 5) & (radius > 2.5),
        "stepped": radius < torch.where(along > 4, 6.0, 3.0),
        "square": (u.abs() < 3.5) & (v.abs() < 3.5),
        "pin": (radius < 4) | ((v.hypot(along - 3) < 1.5) & (u > 0) & (u < 8)),
        "bent": (u - 0.02 * along**2).hypot(v) < 3,
    }[shape]
    return Volume((0.05 * (of & within)).float(), axis_aligned((0.5, 0.5, 0.5), (0, 0, 0)))


@pytest.mark.parametrize("shape", ["rod", "tube", "stepped"])
def test_the_axis_of_a_round_object_is_found(shape: str) -> None:
    axis = round_axis(solid(shape))
    assert axis is not None
    assert float((axis.direction @ AXIS).abs()) > math.cos(math.radians(0.5))
    off = axis.point - MIDDLE
    assert float((off - (off @ AXIS) * AXIS).norm()) < 0.1


@pytest.mark.parametrize("shape", ["square", "pin", "bent"])
def test_an_object_that_is_not_round_has_no_such_axis(shape: str) -> None:
    assert round_axis(solid(shape)) is None


def twist(about: Tensor, rotation_deg: Tensor, centre: Tensor, shift: Tensor) -> Tensor:
    """The motion (6,), degrees and mm, about `centre` of a turn about the point `about`, and a shift."""
    return torch.cat([rotation_deg, shift + torch.linalg.cross(rotation_deg * torch.pi / 180, centre - about)])


def test_only_the_turn_about_the_axis_is_taken_away() -> None:
    pose = EYE.clone()
    pose[:3, :3] = exp_so3(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64))
    pose[:3, 3] = torch.tensor([4.0, -7.0, 600.0])
    along, on_it = pose[:3, :3] @ AXIS, pose[:3, :3] @ MIDDLE + pose[:3, 3]
    centre, none = on_it + torch.tensor([9.0, 2.0, -5.0]), torch.zeros(3, dtype=torch.float64)
    rest = Axis(MIDDLE, AXIS).without_turn(pose, centre)
    assert (rest @ twist(on_it, 40 * along, centre, none)).abs().max() < 1e-9
    shift = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    assert torch.allclose(rest @ twist(on_it, 40 * along, centre, shift), torch.cat([none, shift]))
    tilt = torch.linalg.cross(along, shift)
    assert torch.allclose((rest @ twist(on_it, tilt + 3 * along, centre, none))[:3], tilt)


def test_a_turn_that_is_left_open_is_not_held_against_a_round_object() -> None:
    open_turn = torch.cat([AXIS, torch.zeros(3, dtype=torch.float64)])
    images = 0.01 * torch.eye(6, dtype=torch.float64) + 400 * open_turn[:, None] * open_turn
    nothing = IntrinsicsEstimate(torch.zeros(1), torch.zeros(1))
    covariance = PoseCovariance(("needle",), images, images, MIDDLE[None], nothing, 30 * open_turn)
    poses = Poses(EYE[None], {"needle": EYE})
    asked = _Judged.of(covariance, poses, "needle", None, "pelvis")
    assert max(asked.rotation) > 10
    assert float(asked.pull[:3].norm()) == pytest.approx(30)
    round_one = _Judged.of(covariance, poses, "needle", Axis(MIDDLE, AXIS), "pelvis")
    assert max(round_one.rotation) < 0.11
    assert max(round_one.translation) == pytest.approx(0.1)
    assert round_one.pull.abs().max() < 1e-9


def test_poses_of_a_round_object_are_as_far_apart_as_their_axes() -> None:
    axis = Axis(MIDDLE, AXIS)
    turned, shifted = torch.eye(4).double(), torch.eye(4).double()
    turned[:3, :3] = exp_so3(2.0 * AXIS)
    turned[:3, 3] = MIDDLE - turned[:3, :3] @ MIDDLE  # about the axis
    shifted[:3, 3] = torch.tensor([0.0, 3.0, 4.0])
    assert axis.difference(EYE, turned) == pytest.approx((0, 0), abs=1e-5)
    assert axis.difference(EYE, shifted @ turned) == pytest.approx((0, 5), abs=1e-5)
    tilt = torch.linalg.cross(AXIS, torch.tensor([1.0, 2.0, 3.0]).double())
    tilted = torch.eye(4).double()
    tilted[:3, :3] = exp_so3(0.3 * tilt / tilt.norm())
    assert axis.difference(EYE, tilted @ turned)[0] == pytest.approx(math.degrees(0.3))


@pytest.mark.parametrize(("slot", "round_"), [(False, True), (True, False)])
def test_thin_walls_are_judged(slot: bool, round_: bool) -> None:
    """A cannula of 0.8 mm wall, whole and with a slot of 4 mm."""
    tube = solid("tube")
    z, y, x = torch.meshgrid(*[0.5 * torch.arange(80, dtype=torch.float64)] * 3, indexing="ij")
    away = torch.stack([x, y, z], -1) - MIDDLE
    side = torch.linalg.cross(AXIS, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    u, v = away @ (side / side.norm()), away @ torch.linalg.cross(AXIS, side / side.norm())
    radius, along = u.hypot(v), away @ AXIS
    wall = (radius < 8) & (radius > 7.2) & (along.abs() < 12)
    if slot:
        wall &= ~((u > 0) & (v.abs() < 2))
    assert (round_axis(tube.with_data(0.05 * wall.float())) is not None) is round_


def test_a_point_off_the_axis_depends_on_the_turn() -> None:
    rod = solid("rod")
    side = torch.linalg.cross(AXIS, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    tip = MIDDLE + 60 * AXIS
    assert round_axis(rod, points=[tip]) is not None
    assert round_axis(rod, points=[tip, tip + 3 * side / side.norm()]) is None


@pytest.mark.parametrize(("off", "round_"), [("center", True), ("tip", False)])
def test_a_needle_is_round_wherever_its_errors_are_told(tmp_path: Path, off: str, round_: bool) -> None:
    """Of a needle that lies obliquely in its own frame the middle of its box lies beside its axis."""
    trimesh.creation.cylinder(2.0, 60.0).export(tmp_path / "needle.stl")
    light = 20000 + 20000 * torch.rand((88, 88), generator=torch.Generator().manual_seed(0))
    write_image(tmp_path / "view.tif", light.to(torch.uint16))
    on_axis = {"tip": (0.0, 0.0, 30.0), "base": (0.0, 0.0, -30.0), "center": (0.0, 0.0, 0.0)}
    points = {name: torch.tensor(at).double() for name, at in (on_axis | {off: (4.0, 0.0, 10.0)}).items()}
    start = EYE.clone()
    start[2, 3] = 640
    model = Model(tmp_path / "needle.stl", 5000.0)
    needle = CaseObject(
        "needle", model=model, reference=points["center"], points=points, start=Start(camera1_from=start)
    )
    case = Case(tmp_path, CARM, {"needle": needle}, views=(View({"image": tmp_path / "view.tif"}),))
    assert (prepare_scene(case).objects["needle"].axis is not None) is round_


@pytest.mark.parametrize("where", ["beside", "both sides"])
def test_what_is_round_outside_only_is_not_round(where: str) -> None:
    """A rod of plastic with one wire beside its axis, or with two on opposite sides."""
    rod, wire = solid("rod"), torch.zeros(80, 80, 80, dtype=torch.bool)
    z, y, x = torch.meshgrid(*[0.5 * torch.arange(80, dtype=torch.float64)] * 3, indexing="ij")
    away = torch.stack([x, y, z], -1) - MIDDLE
    side = torch.linalg.cross(AXIS, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    u, v = away @ (side / side.norm()), away @ torch.linalg.cross(AXIS, side / side.norm())
    for sign in (1, -1) if where == "both sides" else (1,):
        wire |= ((u - 2.5 * sign).hypot(v) < 1) & ((away @ AXIS).abs() < 12)
    whole = rod.with_data(rod.data + 0.3 * wire.float())
    middle = rod.with_data(rod.data + 0.3 * ((u.hypot(v) < 1) & ((away @ AXIS).abs() < 12)).float())
    assert round_axis(middle) is not None
    assert round_axis(whole) is None
    assert round_axis(rod, [rod.with_data(0.3 * wire.float())]) is None
