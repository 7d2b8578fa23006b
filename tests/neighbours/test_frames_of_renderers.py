"""Poses of DiffDRR, nanodrr and xvr against what these programs themselves make of them (extra `bench`; xvr apart)."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera, exp_se3, project_points, transform_points
from femoreg_torch.neighbours.frames import (
    diffdrr_offsets,
    from_xvr,
    to_diffdrr,
    to_nanodrr,
    to_nanodrr_intrinsics,
    to_xvr,
)

float64 = torch.float64
CAMERA = Camera(1000.0, (1.3, 1.1), (121, 134), (60.0, 75.0))  # rows are odd; the principal point lies off the middle
BALL_VOXEL = (17.0, 9.0, 20.0)  # x, y, z, off the middle
DISPLAYS = [Display("anterior"), Display("posterior", turned_deg=90), Display("left", mirrored=True, turned_deg=180)]
RAS = torch.tensor([-1.0, -1, 1], dtype=float64)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tensor, Tensor]:
    """An oblique CT with a soft ball: its file, the middle of its grid, and the ball's (both LPS mm)."""
    z, y, x = np.mgrid[:30, :26, :34]
    away = (x - BALL_VOXEL[0]) ** 2 + (y - BALL_VOXEL[1]) ** 2 + (z - BALL_VOXEL[2]) ** 2
    image = sitk.GetImageFromArray((300 * np.exp(-away / 8)).astype(np.float32))
    image.SetSpacing((2.0, 2.4, 1.7))
    image.SetOrigin((-30.0, 44.0, -110.0))
    image.SetDirection(exp_se3(torch.tensor([0.2, -0.1, 0.3, 0, 0, 0], dtype=float64))[:3, :3].flatten().tolist())
    path = tmp_path_factory.mktemp("scan") / "ct.nii.gz"
    sitk.WriteImage(image, str(path))
    middle = image.TransformContinuousIndexToPhysicalPoint([(n - 1) / 2 for n in image.GetSize()])
    ball = image.TransformContinuousIndexToPhysicalPoint(BALL_VOXEL)
    return path, torch.tensor(middle, dtype=float64), torch.tensor(ball, dtype=float64)


def pose_of(display: Display, middle: Tensor) -> Tensor:
    """Head up, from the source's side, and then a little askew."""
    forward, down = torch.tensor(display.beam, dtype=float64), torch.tensor([0, 0, -1.0], dtype=float64)
    turn = torch.eye(4, dtype=float64)
    askew = exp_se3(torch.tensor([0.1, -0.2, 0.15, 0, 0, 0], dtype=float64))[:3, :3]
    turn[:3, :3] = askew @ torch.stack([torch.linalg.cross(down, forward), down, forward])
    turn[:3, 3] = torch.tensor([8.0, -10, 620], dtype=float64) - turn[:3, :3] @ middle
    return turn


def stored_pixels(display: Display, pose: Tensor, points: Tensor) -> Tensor:
    """Where points (N, 3), LPS mm, lie in the stored picture, by this project's own projection."""
    return display.pixels_to_stored(project_points(CAMERA, transform_points(pose, points)), CAMERA)


def middle_of_light(image: Tensor) -> Tensor:
    """Column and row (2,) of the centre of what is seen in an image (H, W)."""
    rows, columns = (torch.arange(n, dtype=float64) for n in image.shape)
    image = image.double()
    return torch.stack([(image.sum(0) * columns).sum(), (image.sum(1) * rows).sum()]) / image.sum()


@pytest.mark.parametrize("reverse_x_axis", [True, False])
@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_diffdrr_casts_rays_projects_and_renders_as_here(
    scan: tuple[Path, Tensor, Tensor], display: Display, reverse_x_axis: bool
) -> None:
    data = pytest.importorskip("diffdrr.data", reason="no DiffDRR here: it comes with the extra `bench`")
    from diffdrr.drr import DRR
    from diffdrr.pose import RigidTransform, convert

    path, middle, ball = scan
    orientation = "AP" if display.flipped != reverse_x_axis else "PA"
    pose, stored = pose_of(display, middle), display.stored_camera(CAMERA)
    x0, y0 = diffdrr_offsets(stored, reverse_x_axis)
    drr = DRR(
        data.read(path, orientation=orientation),
        stored.sdd_mm,
        stored.shape[0],
        stored.pixel_mm[1],
        stored.shape[1],
        stored.pixel_mm[0],
        x0,
        y0,
        reverse_x_axis=reverse_x_axis,
        renderer="trilinear",
    )
    matrix = to_diffdrr(pose, display, middle, orientation, reverse_x_axis)
    theirs = RigidTransform(matrix.float())

    source, targets = drr.detector(theirs, None)
    places = stored_pixels(display, pose, targets[0].double() * RAS + middle)
    rows, columns = torch.meshgrid(*(torch.arange(n) for n in stored.shape), indexing="ij")
    assert (places - torch.stack([columns, rows], -1).reshape(-1, 2)).abs().max() < 0.01
    assert transform_points(pose, source[0].double() * RAS + middle).abs().max() < 0.01

    points = ball + torch.tensor([[0.0, 0, 0], [20, 5, -12], [-15, 30, 3]], dtype=float64)
    seen = drr.perspective_projection(theirs, ((points - middle) * RAS)[None].float())[0] - 0.5
    expected = stored_pixels(display, pose, points)
    assert (seen - expected).abs().max() < 0.01
    assert (middle_of_light(drr(theirs)[0, 0].detach()) - expected[0]).abs().max() < 0.1

    rotation, translation = to_xvr(pose, display, middle, reverse_x_axis=reverse_x_axis, orientation=orientation)
    by_xvr = convert(rotation[None], translation[None], parameterization="euler_angles", convention="ZXY")
    torch.testing.assert_close(by_xvr.matrix[0], matrix)  # as xvr's `FixedPose` makes it


@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_poses_that_xvr_refines_are_those_told_and_come_back(
    scan: tuple[Path, Tensor, Tensor], display: Display
) -> None:
    module = pytest.importorskip("xvr.register.pose", reason="no xvr here")
    from diffdrr.pose import RigidTransform

    middle, pose = scan[1], pose_of(display, scan[1])
    told = {"reverse_x_axis": False, "orientation": "AP" if display.flipped else "PA"}
    theirs = module.Pose(RigidTransform(to_diffdrr(pose, display, middle, **told)), "euler_angles", "ZXY")
    rotation, translation = to_xvr(pose, display, middle, **told)
    torch.testing.assert_close(theirs._rot[0].detach(), rotation)
    torch.testing.assert_close(theirs._xyz[0].detach(), translation)
    torch.testing.assert_close(
        from_xvr(theirs._rot[0].detach(), theirs._xyz[0].detach(), display, middle, **told), pose
    )


@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_nanodrr_renders_as_here(scan: tuple[Path, Tensor, Tensor], display: Display) -> None:
    data = pytest.importorskip("nanodrr.data", reason="no nanodrr here: it comes with the extra `bench`")
    from nanodrr.drr import render

    path, middle, ball = scan
    pose, stored = pose_of(display, middle), display.stored_camera(CAMERA)
    image = render(
        data.Subject.from_filepath(path, convert_to_mu=False),
        to_nanodrr_intrinsics(stored).float()[None],
        to_nanodrr(pose, display).float()[None],
        torch.tensor([stored.sdd_mm]),
        *stored.shape,
        n_samples=100,
    )
    expected = stored_pixels(display, pose, ball[None])[0]
    assert (middle_of_light(image[0].sum(0)) - expected).abs().max() < 0.1
