"""What must hold whatever is rendered: change of world, sums, flips, windows, batches; and the operator's errors."""

import math

import pytest
import torch
from drr_scenes import (
    CAMERA,
    DEVIATING_CAMERA,
    centred,
    facing,
    float64,
    gaussian_ball,
    random_poses,
    smooth,
    sparse,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, exp_se3, project_points, transform_points
from femoreg_torch.volume.grid import Volume

# The AP beam of an upright patient: patient left (+x in LPS) to the right of the image, head up, source in front.
AP = torch.tensor(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 650], [0, 0, 0, 1]],
    dtype=torch.float64,
)


def close(found: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    assert_close(found, expected, atol=tolerance * expected.abs().max().item(), rtol=0)


def centroid(image: Tensor) -> Tensor:
    """Weighted mean (column, row) in pixels."""
    rows, columns = torch.meshgrid(*[torch.arange(n, dtype=torch.float64) for n in image.shape], indexing="ij")
    weight = image.double() / image.double().sum()
    return torch.stack([(columns * weight).sum(), (rows * weight).sum()])


# Frames --------------------------------------------------------------------------------------------------------------
@given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.floats(-500, 500)] * 3))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_moving_camera_and_volume_together_changes_nothing(rotation_vector, shift):
    generator = torch.Generator().manual_seed(0)
    volume = centred(smooth((24, 20, 28), generator), (1.0, 1.5, 2.0))
    poses = random_poses(1, 1, generator)
    new_from_old = exp_se3(float64(*rotation_vector, *shift))
    moved = Volume(volume.data, new_from_old @ volume.lps_from_index)
    close(project([moved], poses @ torch.linalg.inv(new_from_old), CAMERA), project([volume], poses, CAMERA))


def test_patient_left_is_right_in_the_image_and_the_head_is_up():
    grid = centred(torch.zeros(60, 60, 60), (2.0, 2.0, 2.0))
    row_0, column_0 = (n / 2 for n in CAMERA.shape)
    column, row = centroid(project([gaussian_ball(grid, float64(30, 0, 0), 4.0)], AP[None, None], CAMERA)[0])
    assert column > column_0 + 8
    column, row = centroid(project([gaussian_ball(grid, float64(0, 0, 30), 4.0)], AP[None, None], CAMERA)[0])
    assert row < row_0 - 8


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 0.8, 2.5), (2.0, 1.0, 1.0)], ids=str)
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_ball_lands_where_its_centre_projects(spacing, factor):
    """To a tenth of a pixel: half a voxel, or half a pixel, in the wrong place would show."""
    camera = centred_camera(1020.0, (1.0, 1.3), (160, 120)).downsampled(factor)
    shape = [round(90 / s) for s in reversed(spacing)]
    grid = centred(torch.zeros(shape), spacing, (0.1, -0.2, 0.3))
    for centre in (float64(17.3, -11.9, 20.4), float64(-20.2, 14.6, -13.7)):
        ball = gaussian_ball(grid, centre, sigma_mm=4.0)
        for pose in (AP, AP @ exp_se3(float64(0.2, 0.4, -0.1, 5, 6, 20))):
            expected = project_points(camera, transform_points(pose, centre[None]))[0]
            assert (centroid(project([ball], pose[None, None], camera)[0]) - expected).abs().max() < 0.1


def test_flipping_the_phantom_flips_the_image():
    """A phantom marked at its left, mirrored in x: the image is mirrored, and is not what it was."""
    generator = torch.Generator().manual_seed(1)
    data = smooth((30, 30, 30), generator)
    data[10:14, 10:14, 25:28] += 0.5
    image = project([centred(data)], AP[None, None], CAMERA)
    mirrored = project([centred(data.flip(2))], AP[None, None], CAMERA)
    close(mirrored.flip(-1), image)
    assert (mirrored - image).abs().max() > 0.1 * image.max()
    upside_down = project([centred(data.flip(0))], AP[None, None], CAMERA)
    close(upside_down.flip(-2), image)
    back_to_front = project([centred(data.flip(1))], AP[None, None], CAMERA)
    assert (back_to_front - image).abs().max() > 1e-3 * image.max()  # perspective tells front from back


# Sums ----------------------------------------------------------------------------------------------------------------
def test_volumes_add_and_can_be_kept_apart():
    generator = torch.Generator().manual_seed(2)
    volumes = [
        centred(smooth((20, 22, 24), generator)),
        centred(sparse((16, 30, 20), generator), (2, 1, 1.5)),
        centred(torch.zeros(4, 4, 4)),
    ]
    poses = random_poses(2, 3, generator)
    apart = project(volumes, poses, CAMERA, separate=True)
    assert apart.shape == (2, 3, *CAMERA.shape)
    for v, volume in enumerate(volumes):
        assert torch.equal(apart[:, v], project([volume], poses[:, v : v + 1], CAMERA))
    together = project(volumes, poses, CAMERA)
    assert together.dtype == torch.float32
    close(together, apart.sum(1), 1e-6)


def test_a_volume_cut_in_two_adds_up():
    generator = torch.Generator().manual_seed(3)
    data = smooth((24, 26, 28), generator)
    upper, lower = data.clone(), data.clone()
    upper[:11], lower[11:] = 0, 0
    poses = random_poses(2, 1, generator)
    parts = project([centred(upper), centred(lower)], poses.expand(-1, 2, -1, -1), CAMERA)
    close(parts, project([centred(data)], poses, CAMERA))


def test_the_image_is_proportional_to_the_attenuation():
    generator = torch.Generator().manual_seed(4)
    data, poses = smooth((20, 20, 20), generator), random_poses(1, 1, generator)
    close(project([centred(4 * data)], poses, CAMERA), 4 * project([centred(data)], poses, CAMERA), 1e-7)


def test_the_image_does_not_depend_on_the_step_beyond_its_sampling_error():
    generator = torch.Generator().manual_seed(5)
    volume, poses = centred(smooth((30, 30, 30), generator), (2, 2, 2)), random_poses(1, 1, generator)
    close(project([volume], poses, CAMERA, step_mm=1.0), project([volume], poses, CAMERA, step_mm=0.1), 1e-2)


# Windows, batches, repetition ----------------------------------------------------------------------------------------
WINDOWS = [
    (slice(5, 29), slice(8, 24)),
    (slice(8, 40), slice(16, 40)),
    (slice(20, 21), slice(7, 8)),
]


@pytest.mark.parametrize(("rows", "columns"), WINDOWS, ids=str)
@pytest.mark.parametrize("filling", [smooth, sparse])
def test_a_window_is_a_crop_of_the_full_image(filling, rows, columns):
    generator = torch.Generator().manual_seed(6)
    volume, poses = centred(filling((40, 44, 48), generator)), random_poses(3, 1, generator)
    full = project([volume], poses, CAMERA)[:, rows, columns]
    assert torch.equal(project([volume], poses, CAMERA.window(rows, columns)), full)


@pytest.mark.parametrize("filling", [smooth, sparse])
def test_every_third_pixel_is_the_same_to_rounding(filling):
    """Pixels that lie further apart travel in other packets, which rounds the float32 sums another way."""
    generator = torch.Generator().manual_seed(6)
    volume, poses = centred(filling((40, 44, 48), generator)), random_poses(3, 1, generator)
    rows, columns = slice(3, None, 4), slice(1, None, 3)
    close(project([volume], poses, CAMERA.window(rows, columns)), project([volume], poses, CAMERA)[:, rows, columns])


@pytest.mark.parametrize("step_mm", [2.0, 1.0, 0.5])
def test_a_volume_that_moves_in_depth_keeps_its_integral_along_the_middle_ray(step_mm):
    """Samples go along: at fixed places along the ray the sum would rise and fall with every step of depth."""
    volume = centred(sparse((20, 21, 40), torch.Generator().manual_seed(3), 0.3))
    depths = torch.arange(600.0, 603.0, 0.05, dtype=torch.float64)
    poses = torch.cat([facing(float(z)) for z in depths])
    middle = project([volume], poses, centred_camera(1000.0, (1.0, 1.0), (1, 1)), step_mm)[:, 0, 0]
    assert middle.mean() > 1
    assert float(middle.max() - middle.min()) < 2e-3 * float(middle.mean())


def test_a_pose_renders_the_same_alone_and_in_a_batch():
    generator = torch.Generator().manual_seed(7)
    volumes = [centred(smooth((30, 26, 34), generator)), centred(sparse((20, 20, 20), generator), (3, 3, 3))]
    poses = random_poses(5, 2, generator)
    poses[3, :, 2, 3] = 250.0  # much closer to the source than the others
    batch = project(volumes, poses, DEVIATING_CAMERA)
    for pose, image in zip(poses, batch, strict=True):
        assert torch.equal(project(volumes, pose[None], DEVIATING_CAMERA)[0], image)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_image_is_the_same_with_and_without_a_gradient(dtype):
    generator = torch.Generator().manual_seed(9)
    volume, poses = centred(smooth((30, 26, 34), generator)), random_poses(3, 1, generator)[:, 0].to(dtype)
    followed = project(volume, poses.clone().requires_grad_(), CAMERA)
    close(project(volume, poses, CAMERA), followed.detach(), 1e-6)


def test_two_runs_agree_bit_for_bit():
    generator = torch.Generator().manual_seed(8)
    volume, poses = centred(smooth((30, 30, 30), generator)), random_poses(4, 1, generator)
    assert torch.equal(project([volume], poses, CAMERA), project([volume], poses, CAMERA))
    first, second = (project_with_jacobian(volume, poses[:, 0], CAMERA, float64(0, 0, 600))[1] for _ in range(2))
    assert torch.equal(first, second)


def test_data_changed_in_place_are_noticed():
    volume = centred(torch.ones(10, 10, 10))
    image = project([volume], facing(), CAMERA)
    volume.data.mul_(2)
    close(project([volume], facing(), CAMERA), 2 * image, 1e-6)
    volume.data[:] = 0
    assert not project([volume], facing(), CAMERA).any()


def test_volumes_are_kept_apart_by_identity():
    one, other = centred(torch.ones(10, 10, 10)), centred(torch.full((10, 10, 10), 3.0))
    close(project([other], facing(), CAMERA), 3 * project([one], facing(), CAMERA), 1e-6)


def test_one_volume_needs_no_axis_of_volumes():
    generator = torch.Generator().manual_seed(3)
    volume, poses = centred(smooth((12, 10, 11), generator)), random_poses(3, 1, generator)[:, 0]
    assert torch.equal(project(volume, poses, CAMERA), project([volume], poses[:, None], CAMERA))
    assert torch.equal(project(volume, poses, CAMERA, separate=True)[:, 0], project(volume, poses, CAMERA))


# Errors --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("shape", [(1, 4, 4), (1, 2, 4, 4), (1, 1, 3, 4), (1, 1, 1, 4, 4)], ids=str)
def test_poses_of_the_wrong_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"poses of shape \(B, 1, 4, 4\)"):
        project([centred(torch.ones(4, 4, 4))], torch.zeros(shape), CAMERA)


@pytest.mark.parametrize("shape", [(4, 4), (1, 1, 4, 4), (1, 3, 4)], ids=str)
def test_poses_of_one_volume_of_the_wrong_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"one volume needs poses of shape \(B, 4, 4\)"):
        project(centred(torch.ones(4, 4, 4)), torch.zeros(shape), CAMERA)


def test_poses_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="not finite"):
        project([centred(torch.ones(4, 4, 4))], facing(math.nan), CAMERA)


@pytest.mark.parametrize("with_gradient", [False, True])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda pose: pose[3, 3].fill_(2), "last row"),
        (lambda pose: pose[3, 2].fill_(0.1), "last row"),
        (lambda pose: pose[:3, :3].zero_(), "no inverse"),
        (lambda pose: pose[1, 1].fill_(1e-15), "no inverse"),
        (lambda pose: pose[0, 3].fill_(1e30), "out of reach"),
        (lambda pose: pose[0, 3].fill_(math.inf), "not finite"),
        (lambda pose: pose[:3, :3].mul_(1e8), "samples"),
    ],
)
def test_poses_that_the_kernels_cannot_follow_are_refused(change, says, with_gradient):
    """Without the check they read out of bounds, which ends the process, or run for ever."""
    volume, pose = centred(torch.ones(4, 4, 4)), facing()[:, 0].clone()
    change(pose[0])
    pose.requires_grad_(with_gradient)
    with pytest.raises(InputError, match=says):
        project(volume, pose, CAMERA)
    with pytest.raises(InputError, match=says):
        project_with_jacobian(volume, pose.detach(), CAMERA, float64(0, 0, 620))


@pytest.mark.parametrize("step_mm", [0, -1.0, math.nan, math.inf, "1", None])
def test_steps_that_are_none_are_refused(step_mm):
    volume, pose = centred(torch.ones(4, 4, 4)), facing()[:, 0]
    with pytest.raises(InputError, match=r"step_mm must be positive and finite, got"):
        project(volume, pose, CAMERA, step_mm)
    with pytest.raises(InputError, match=r"step_mm must be positive and finite, got"):
        project_with_jacobian(volume, pose, CAMERA, float64(0, 0, 620), step_mm)


def test_a_step_may_be_short_but_not_endlessly():
    """A million samples along the diagonal of a volume are several hundred per voxel of a large CT."""
    volume, pose, camera = centred(torch.ones(4, 4, 4)), facing()[:, 0], centred_camera(1000.0, (1.0, 1.0), (1, 1))
    assert project(volume, pose, camera, 1e-4)[0, 0, 0] == pytest.approx(4, rel=1e-3)
    with pytest.raises(InputError, match=r"samples through a volume of 5 mm at step_mm = 1e-09; 1e\+06 are the limit"):
        project(volume, pose, camera, 1e-9)
    huge = Volume(torch.ones(4, 4, 4), float64(1e5, 1e5, 1e5, 1).diag())
    with pytest.raises(InputError, match="in mm"):
        project(huge, pose, camera, 0.1)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda volume, poses: project([], poses[:, None], CAMERA), "no volume"),
        (lambda volume, poses: project([volume.data], poses[:, None], CAMERA), "a Volume or a list"),
        (lambda volume, poses: project(volume, poses.numpy(), CAMERA), "torch tensor, got ndarray"),
        (lambda volume, poses: project([volume], poses[:, None].numpy(), CAMERA), "torch tensor, got ndarray"),
        (lambda volume, poses: project(volume, poses.to(torch.complex128), CAMERA), "complex"),
        (lambda volume, poses: project(volume, poses, CAMERA.shape), "a Camera is needed"),
        (lambda volume, poses: project_with_jacobian(volume, poses.numpy(), CAMERA, poses[0, :3, 3]), "torch tensor"),
        (lambda volume, poses: project_with_jacobian(volume, poses[0], CAMERA, poses[0, :3, 3]), r"\(B, 4, 4\)"),
        (lambda volume, poses: project_with_jacobian(volume, poses, CAMERA, poses[0, :3]), "a centre of shape"),
    ],
)
def test_arguments_of_the_wrong_kind_are_told_in_one_line(call, says):
    with pytest.raises(InputError, match=says):
        call(centred(torch.ones(4, 4, 4)), facing()[:, 0])
