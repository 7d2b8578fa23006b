"""Poses of other programs: against what those programs project, against literal cases, and there and back."""

import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import SOURCES, TURNS, Display
from femoreg_torch.geometry import Camera, exp_se3, project_points, transform_points
from femoreg_torch.neighbours.frames import (
    XregCamera,
    from_diffdrr,
    from_nanodrr,
    from_nanodrr_intrinsics,
    from_xvr,
    to_diffdrr,
    to_nanodrr,
    to_nanodrr_intrinsics,
    to_xvr,
)

float64 = torch.float64
MIDDLE = torch.tensor([3.0, -12.0, 240.0], dtype=float64)
POINTS = MIDDLE + torch.tensor([[0.0, 0, 0], [40, 5, -20], [-25, 30, 33], [10, -44, 8]], dtype=float64)
DISPLAYS = [Display(source, mirrored, turn) for source in SOURCES for mirrored in (False, True) for turn in TURNS]
CAMERA = Camera(1000.0, (0.8, 0.5), (200, 260), (140.0, 90.0))  # as the source sees it


def pose_of(display: Display) -> torch.Tensor:
    """Head up, from the source's side, and then a little askew."""
    forward = torch.tensor(display.beam, dtype=float64)
    down = torch.tensor([0, 0, -1.0], dtype=float64)
    turn = torch.eye(4, dtype=float64)
    turn[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    turn[:3, 3] = torch.tensor([5.0, -8, 620], dtype=float64) - turn[:3, :3] @ MIDDLE
    return exp_se3(torch.tensor([0.1, -0.2, 0.15, 3, 2, -9], dtype=float64)) @ turn


def stored_pixels(display: Display, points: torch.Tensor = POINTS) -> torch.Tensor:
    """Where the points lie in the picture as it is stored, by this project's own projection."""
    seen = project_points(CAMERA, transform_points(pose_of(display), points))
    return display.pixels_to_stored(seen, CAMERA)


@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_nanodrr_projects_to_the_same_pixels_and_comes_back(display: Display) -> None:
    stored = display.stored_camera(CAMERA)
    rt_inv, k_inv = to_nanodrr(pose_of(display), display), to_nanodrr_intrinsics(stored)
    # as its page says: K [R | t] takes RAS mm to pixels whose centres lie at + 0.5
    ras = POINTS * torch.tensor([-1.0, -1, 1], dtype=float64)
    seen = torch.linalg.inv(k_inv) @ transform_points(torch.linalg.inv(rt_inv), ras).T
    torch.testing.assert_close((seen[:2] / seen[2]).T - 0.5, stored_pixels(display))
    torch.testing.assert_close(from_nanodrr(rt_inv, display), pose_of(display))
    back = from_nanodrr_intrinsics(k_inv, stored.sdd_mm, stored.shape)
    assert back.shape == stored.shape
    assert (*back.pixel_mm, *back.principal_point_px) == pytest.approx((*stored.pixel_mm, *stored.principal_point_px))
    with pytest.raises(InputError, match="mirror image"):
        from_nanodrr(rt_inv, Display(display.source, not display.mirrored, display.turned_deg))


def test_nanodrr_from_the_front_is_what_its_own_function_makes() -> None:
    nanodrr = pytest.importorskip("nanodrr.camera.extrinsics")
    zero = torch.zeros(1, 3, dtype=float64)
    pose = from_nanodrr(nanodrr.make_rt_inv(zero, torch.tensor([[0.0, 700, 0]], dtype=float64), "AP")[0], Display())
    assert pose[2, :3].tolist() == [0, 1, 0]  # the beam runs from front to back
    assert pose[1, :3].tolist() == [0, 0, -1]  # rows run to the feet


@pytest.mark.parametrize("reverse_x_axis", [True, False])
@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_diffdrr_and_xvr_come_back(display: Display, reverse_x_axis: bool) -> None:
    orientation, other = ("AP", "PA") if display.flipped != reverse_x_axis else ("PA", "AP")
    pose = to_diffdrr(pose_of(display), display, MIDDLE, orientation, reverse_x_axis)
    torch.testing.assert_close(from_diffdrr(pose, display, MIDDLE, orientation, reverse_x_axis), pose_of(display))
    with pytest.raises(InputError, match="DiffDRR: its orientation"):
        to_diffdrr(pose_of(display), display, MIDDLE, other, reverse_x_axis)
    told = {"reverse_x_axis": reverse_x_axis, "orientation": orientation}
    rotation, translation = to_xvr(pose_of(display), display, MIDDLE, **told)
    torch.testing.assert_close(from_xvr(rotation, translation, display, MIDDLE, **told), pose_of(display))


def test_diffdrr_from_the_front_is_a_shift_along_its_beam() -> None:
    """Its tutorial: no rotation and a translation of (0, 850, 0) is an AP view with the source 850 mm in front."""
    pose = torch.eye(4, dtype=float64)
    pose[1, 3] = 850.0
    found = from_diffdrr(pose, Display(), MIDDLE)
    assert transform_points(found, MIDDLE[None])[0].tolist() == pytest.approx([0, 0, 850])
    assert found[:3, :3].tolist() == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]


@pytest.mark.parametrize("display", [Display("posterior"), Display("posterior", turned_deg=180)], ids=str)
def test_xreg_projects_to_the_same_pixels_and_comes_back(display: Display) -> None:
    stored = display.stored_camera(CAMERA)
    intrinsic = stored.matrix() * torch.tensor([[-1.0, 1, 1], [1, -1, 1], [1, 1, 1]], dtype=float64)
    extrinsic = exp_se3(torch.tensor([0.2, 1.1, -0.4, 50, -20, -630], dtype=float64))
    carm = XregCamera(intrinsic, extrinsic, stored.shape, stored.pixel_mm)
    lps_from_world = carm.lps_from_world(pose_of(display), display)
    assert torch.linalg.det(lps_from_world[:3, :3]).item() == pytest.approx(1)
    # the projection that the readme of the DeepFluoro data gives: K [E inv(cam-to-vol)] X
    seen = intrinsic @ transform_points(extrinsic @ torch.linalg.inv(lps_from_world), POINTS).T
    torch.testing.assert_close((seen[:2] / seen[2]).T, stored_pixels(display))
    torch.testing.assert_close(carm.camera_from_lps(lps_from_world, display), pose_of(display))
    assert carm.camera.principal_point_px == pytest.approx(stored.principal_point_px)
    with pytest.raises(InputError, match="mirror image"):
        carm.camera_from_lps(lps_from_world, Display("anterior"))
