"""The Triton kernels on CPU tensors, through Triton's interpreter, against SciPy and the CPU kernels.

Run by `test_triton.py` in a process of its own, because the interpreter must be chosen before Triton is imported:
`TRITON_INTERPRET=1 pytest tests/drr/interpreted_kernels.py`. The interpreter is slow, so all scenes are tiny.
"""

import numpy as np
import pytest
import torch
from drr_scenes import (
    centred,
    facing,
    marched,
    offsets,
    random_poses,
    relative_error,
    smooth,
    sparse,
    truth,
)
from torch import Tensor

from femoreg_torch.drr import cpu, cuda
from femoreg_torch.drr.bricks import BRICK, bricked
from femoreg_torch.drr.device_bricks import bricked_on_device
from femoreg_torch.geometry import Camera, centred_camera, exp_se3
from femoreg_torch.volume.grid import Volume

CAMERA = Camera(900.0, (9.0, 11.0), (11, 9), (4.3, 5.8))  # off centre, pixels and detector not square
ONE_LARGE_TILE = 16  # the interpreter's time goes by operations, not by rays
TOLERANCE = 2e-5  # as for the CPU kernels: float32 sums, relative to the largest pixel


def affines(volume: Volume, poses: Tensor) -> Tensor:
    return torch.linalg.inv(poses[:, 0] @ volume.lps_from_index)[:, :3]


def by_triton(
    volume: Volume, poses: Tensor, camera: Camera = CAMERA, step_mm: float = 2.0, tile: int = ONE_LARGE_TILE
) -> Tensor:
    at = offsets(volume, poses[:, 0], step_mm)
    return cuda.project(volume, affines(volume, poses), camera, at, step_mm, tile)


def error(
    volume: Volume, poses: Tensor, camera: Camera = CAMERA, step_mm: float = 2.0, tile: int = ONE_LARGE_TILE
) -> float:
    expected = truth([volume], poses, camera, step_mm)[:, 0]
    assert expected.any()
    return relative_error(by_triton(volume, poses, camera, step_mm, tile), expected)


@pytest.mark.parametrize("filling", [smooth, sparse])
def test_turned_volumes_and_tiles_that_overhang_the_detector(filling):
    generator = torch.Generator().manual_seed(1)
    volume = centred(filling((11, 14, 17), generator), (1.6, 2.0, 3.1), (0.3, 0.1, -0.2))
    assert error(volume, random_poses(1, 1, generator), step_mm=2.3, tile=8) < TOLERANCE


def test_long_empty_stretches():
    """Alone, each of the two parts is met after a leap; tiles see one, both or none of them."""
    generator = torch.Generator().manual_seed(2)
    data = torch.zeros(40, 40, 60)
    data[2:6, 3:8, 4:9] = sparse((4, 5, 5), generator, 0.2)
    data[31:38, 30:34, 50:58] = smooth((7, 4, 8), generator)
    volume = centred(data)
    camera = centred_camera(900.0, (10.0, 11.0), (6, 7))
    assert error(volume, facing(620.0, (0.2, 1.0, 0.1)), camera, 1.0, tile=4) < TOLERANCE


def test_empty_space_is_not_read():
    """A few samples past a filled brick or a face may be taken for nothing; further off there may be anything."""
    data = torch.zeros(30, 30, 60)
    data[13:17, 13:17, 3:6] = data[12:16, 12:16, 55:58] = 1.0
    volume, pose, camera = centred(data), facing(620.0, (0.0, 1.4, 0.0)), centred_camera(900.0, (2.0, 3.0), (3, 8))
    expected = by_triton(volume, pose, camera, 1.0)
    bricks = bricked_on_device(volume)
    far = torch.zeros_like(bricks.leap)
    far[3:-3, 3:-3, 3:-3] = bricks.leap[3:-3, 3:-3, 3:-3] >= 3
    for axis in range(3):
        far = far.repeat_interleave(BRICK, axis)
    bricks.padded[far == 1] = torch.nan
    assert far.any()
    assert (expected > 0).sum() > 4
    assert torch.equal(by_triton(volume, pose, camera, 1.0), expected)


def test_rays_along_the_grid():
    """Whole steps on whole voxels: every sample lies on a boundary that a leap must not fall over."""
    volume = centred(sparse((13, 11, 9), torch.Generator().manual_seed(3), share=0.03))
    camera = centred_camera(1e6, (1.0, 1.0), (15, 15))
    for axis in ((0.0, 0.0, 0.0), (1.5707963267948966, 0.0, 0.0)):
        assert error(volume, facing(999_990.0, axis), camera, 1.0) < TOLERANCE


def test_indices_of_a_thousand_cost_no_accuracy():
    """A rod seen along its axis: some rays pass all of it before they meet the far end, others enter from the side."""
    data = torch.zeros(1000, 6, 5)
    data[960:] = sparse((40, 6, 5), torch.Generator().manual_seed(4), 0.3)
    volume = centred(data, (0.5, 0.5, 0.5))
    pose = facing(700.0, (0.002, 0.003, 0.0), -0.7, 0.5)
    rounding = 6e-5  # of float32 at a thousand voxels
    assert error(volume, pose, centred_camera(1000.0, (0.4, 0.4), (14, 12)), 1.0) < rounding


def test_the_source_inside_and_rays_that_miss():
    volume = centred(smooth((12, 12, 12), torch.Generator().manual_seed(5)), (2.0, 2.0, 2.0))
    assert error(volume, facing(3.0, x_mm=2.0)) < TOLERANCE
    assert not by_triton(volume, facing(x_mm=400.0)).any()
    assert not by_triton(volume.with_data(torch.zeros(12, 12, 12)), facing()).any()


@pytest.mark.parametrize("value", [torch.nan, 1e300])
def test_a_pose_that_is_not_sane_gives_nan_and_spoils_no_other(value):
    volume = centred(smooth((5, 5, 5), torch.Generator().manual_seed(6)), (4.0, 4.0, 4.0))
    rows = affines(volume, torch.cat([facing(), facing()]))
    rows[0, 1, 3] = value
    at = offsets(volume, torch.cat([facing(), facing()])[:, 0], 4.0)
    image = cuda.project(volume, rows, CAMERA, at, 4.0, ONE_LARGE_TILE)
    assert image[0].isnan().all()
    assert torch.equal(image[1:], by_triton(volume, facing(), step_mm=4.0))


def test_a_window_is_a_crop_and_a_batch_changes_nothing():
    generator = torch.Generator().manual_seed(7)
    volume = centred(sparse((10, 10, 10), generator, 0.05), (2.0, 2.0, 2.0))
    poses = random_poses(2, 1, generator)
    image = by_triton(volume, poses)
    assert torch.equal(image[1:], by_triton(volume, poses[1:]))
    window = by_triton(volume, poses[:1], CAMERA.window(slice(3, 10), slice(2, 7)))
    assert relative_error(window, image[:1, 3:10, 2:7].double()) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_rounds_the_values_and_nothing_else(dtype):
    generator = torch.Generator().manual_seed(8)
    volume = centred(smooth((10, 11, 12), generator).to(dtype), (2.0, 2.0, 2.0))
    rounded = volume.with_data(volume.data.float())
    image = by_triton(volume, facing())
    assert image.dtype == torch.float32
    assert relative_error(image, truth([rounded], facing(), CAMERA, 2.0)[:, 0]) < TOLERANCE


def test_gradients_agree_with_autograd_through_the_march():
    generator = torch.Generator().manual_seed(9)
    volume = centred(smooth((9, 11, 10), generator), (2.1, 1.9, 3.0), (0.3, 0.1, -0.2))
    poses = random_poses(2, 1, generator)
    weights = torch.randn(2, *CAMERA.shape, generator=generator)
    gradients = []
    for render, dtype in ((by_triton, torch.float32), (lambda v, p: marched([v], p, CAMERA, 2.0)[:, 0], torch.float64)):
        data, moving = volume.data.to(dtype, copy=True).requires_grad_(), poses.clone().requires_grad_()
        (render(volume.with_data(data), moving) * weights).sum().backward()
        gradients.append((moving.grad, data.grad))
    assert relative_error(gradients[0][0], gradients[1][0]) < 1e-4
    assert relative_error(gradients[0][1], gradients[1][1]) < 1e-5


def test_jacobian_image_agrees_with_the_one_of_the_cpu():
    generator = torch.Generator().manual_seed(10)
    volume = centred(smooth((9, 11, 10), generator), (2.1, 1.9, 3.0))
    poses = random_poses(1, 1, generator)
    small = 1e-5 * torch.eye(6, dtype=torch.float64)
    moved = [torch.stack([affines(volume, exp_se3(s) @ poses) for s in steps], 1) for steps in (small, -small)]
    changes, at = ((moved[0] - moved[1]) / 2e-5).numpy(), offsets(volume, poses[:, 0], 2.0).numpy()
    placed, rates = affines(volume, poses).numpy(), np.array([[0.3, -0.2, 0.0, 0.1, -0.4, 1.0]])
    found = cuda.jacobian(volume, placed, changes, rates, CAMERA, at, 2.0, ONE_LARGE_TILE)
    image, moments = cpu.projection_with_moments(bricked(volume), placed, CAMERA, at, 2.0)
    slides = rates[:, :, None, None] * placed[:, None, :, :3]
    expected = torch.from_numpy(cpu.jacobian(moments, CAMERA, changes, slides))
    assert relative_error(found[0], torch.from_numpy(image).double()) < TOLERANCE
    for dof in range(6):
        assert relative_error(found[1][:, dof], expected[:, dof].double()) < TOLERANCE
