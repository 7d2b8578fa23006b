"""Derivatives with respect to pose and volume: finite differences of, and autograd through, the float64 march."""

import math

import pytest
import torch
from drr_scenes import (
    CAMERA,
    DEVIATING_CAMERA,
    centred,
    facing,
    float64,
    marched,
    random_poses,
    relative_error,
    smooth,
    sparse,
    truth,
)
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.geometry import CameraChange, about_point, exp_se3
from femoreg_torch.volume.grid import Volume

SCALE = float64(0.02, 0.02, 0.02, 1, 1, 1)  # so that rotations and shifts weigh about the same


def scene(filling=smooth, seed: int = 0, poses: int = 2) -> tuple[list[Volume], Tensor, Tensor, torch.Generator]:
    """Two volumes, poses (B, 2, 4, 4), random weights (B, H, W) and the generator."""
    generator = torch.Generator().manual_seed(seed)
    volumes = [
        centred(filling((22, 26, 30), generator), (1.1, 0.9, 2.0), (0.3, 0.1, -0.2)),
        centred(filling((18, 20, 16), generator), (2.0, 2.0, 2.0)),
    ]
    return (
        volumes,
        random_poses(poses, 2, generator),
        torch.randn(poses, *CAMERA.shape, generator=generator),
        generator,
    )


@pytest.mark.parametrize("filling", [smooth, sparse])
def test_pose_gradient_agrees_with_autograd_through_the_march(filling):
    volumes, poses, weights, _ = scene(filling)
    gradients = []
    for render in (lambda p: project(volumes, p, CAMERA), lambda p: marched(volumes, p, CAMERA).sum(1)):
        twist = torch.zeros(2, 2, 6, dtype=torch.float64, requires_grad=True)
        (render(exp_se3(twist * SCALE) @ poses) * weights).sum().backward()
        gradients.append(twist.grad)
    assert relative_error(gradients[0], gradients[1]) < 2e-5


def test_pose_gradient_agrees_with_finite_differences_of_the_march():
    volumes, poses, weights, _ = scene(poses=1)

    def loss(twist: Tensor) -> Tensor:
        return (truth(volumes, exp_se3(twist * SCALE) @ poses, CAMERA).sum(1) * weights).sum()

    twist = torch.zeros(1, 2, 6, dtype=torch.float64, requires_grad=True)
    (project(volumes, exp_se3(twist * SCALE) @ poses, CAMERA) * weights).sum().backward()
    expected = torch.zeros_like(twist)
    for volume in range(2):
        for dof in range(6):
            step = torch.zeros_like(expected)
            step[0, volume, dof] = 1e-7  # few samples pass from one voxel to the next
            expected[0, volume, dof] = (loss(step) - loss(-step)) / 2e-7
    assert relative_error(twist.grad, expected) < 2e-5


def test_pose_gradient_of_separate_images():
    volumes, poses, weights, generator = scene()
    weights = torch.stack([weights, torch.randn(weights.shape, generator=generator)], 1)
    gradients = []
    for render in (lambda p: project(volumes, p, CAMERA, separate=True), lambda p: marched(volumes, p, CAMERA)):
        moving = poses.clone().requires_grad_()
        (render(moving) * weights).sum().backward()
        gradients.append(moving.grad[..., :3, :])
    assert relative_error(gradients[0], gradients[1]) < 2e-5


@pytest.mark.parametrize("camera", [CAMERA, DEVIATING_CAMERA], ids=["square", "off centre"])
@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (12.0, -30.0, 640.0)], ids=["source", "point"])
def test_jacobian_image_agrees_with_finite_differences_of_the_march(centre, camera):
    volumes, poses, _, _ = scene()
    volume, pose, about = volumes[0], poses[:, 0], float64(*centre)
    image, jacobian = project_with_jacobian(volume, pose, camera, about)
    assert_close(image, project([volume], pose[:, None], camera), atol=1e-5 * image.max().item(), rtol=0)
    for dof in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[dof] = 1e-6 * SCALE[dof]  # few samples pass from one voxel to the next
        there, back = (truth([volume], (about_point(exp_se3(s), about) @ pose)[:, None], camera) for s in (step, -step))
        expected = (there - back)[:, 0] / (2 * step[dof])
        gap = (jacobian[..., dof].double() - expected).square().mean().sqrt() / expected.square().mean().sqrt()
        assert gap < 1e-3, f"degree of freedom {dof}"


@pytest.mark.parametrize("camera", [CAMERA, DEVIATING_CAMERA], ids=["square", "off centre"])
def test_derivatives_by_the_intrinsics_agree_with_finite_differences_of_the_march(camera):
    volumes, poses, _, _ = scene()
    volume, pose = volumes[0], poses[:, 0]
    plain = project_with_jacobian(volume, pose, camera, float64(0, 0, 0))[1]
    jacobian = project_with_jacobian(volume, pose, camera, float64(0, 0, 0), intrinsics=True)[1]
    assert_close(jacobian[..., :6], plain)
    h = 1e-6
    steps = [(h, lambda s: CameraChange(math.exp(s)))]
    steps += [(1e-5, lambda s: CameraChange(1.0, (s, 0.0))), (1e-5, lambda s: CameraChange(1.0, (0.0, s)))]
    for n, (size, change) in enumerate(steps):
        there, back = (truth([volume], pose[:, None], camera.changed(change(s))) for s in (size, -size))
        expected = (there - back)[:, 0] / (2 * size)
        gap = (jacobian[..., 6 + n].double() - expected).square().mean().sqrt() / expected.square().mean().sqrt()
        assert gap < 2e-3, f"intrinsic {n}"


def test_jacobian_image_agrees_with_the_gradient():
    volumes, poses, weights, _ = scene()
    centre = float64(3.0, -8.0, 610.0)
    _, jacobian = project_with_jacobian(volumes[0], poses[:, 0], CAMERA, centre)
    twist = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    moved = about_point(exp_se3(twist), centre) @ poses[:, 0]
    (project(volumes[:1], moved[:, None], CAMERA) * weights).sum().backward()
    expected = torch.einsum("bhw,bhwd->bd", weights, jacobian).double()
    assert relative_error(expected / SCALE, twist.grad / SCALE) < 2e-5


@pytest.mark.parametrize("loss", [lambda image: image.sum(), lambda image: image.square().sum()])
def test_an_image_cannot_be_differentiated_twice_by_a_pose_and_says_so(loss) -> None:
    volumes, poses, _, _ = scene()

    def of(twist: Tensor) -> Tensor:
        return loss(project(volumes[0], exp_se3(twist[None]) @ poses[:1, 0], CAMERA))

    with pytest.raises(RuntimeError, match="an image of `project` cannot be differentiated twice"):
        torch.autograd.functional.hessian(of, torch.zeros(6, dtype=torch.float64))


def test_a_linear_loss_is_linear_in_the_volume_and_no_error():
    volumes, poses, weights, _ = scene()
    data = volumes[0].data.clone().requires_grad_()
    image = project(Volume(data, volumes[0].lps_from_index), poses[:, 0], CAMERA)
    (slope,) = torch.autograd.grad((image * weights).sum(), data, create_graph=True)
    assert not slope.requires_grad


def test_volume_gradient_agrees_with_autograd_through_the_march():
    volumes, poses, weights, _ = scene()
    gradients = []
    for render in (project, marched):
        data = volumes[0].data.clone().double() if render is marched else volumes[0].data.clone()
        data.requires_grad_()
        image = render([volumes[0].with_data(data)], poses[:, :1], CAMERA)
        (image.reshape(weights.shape) * weights).sum().backward()
        gradients.append(data.grad)
    assert relative_error(gradients[0], gradients[1]) < 5e-6


def test_volume_gradient_reaches_empty_voxels_and_a_source_inside():
    """What is empty now may be filled next: reconstruction starts from nothing."""
    weights = torch.rand(1, *CAMERA.shape, generator=torch.Generator().manual_seed(1))
    for pose in (facing(), facing(5.0)):
        gradients = []
        for render, dtype in ((project, torch.float32), (marched, torch.float64)):
            volume = centred(torch.zeros(20, 20, 20, dtype=dtype, requires_grad=True), (2.0, 2.0, 2.0))
            (render([volume], pose, CAMERA).reshape(weights.shape) * weights).sum().backward()
            gradients.append(volume.data.grad)
        assert gradients[1].any()
        assert relative_error(gradients[0], gradients[1]) < 5e-6


def test_the_volume_gradient_is_the_adjoint():
    """⟨project(x), y⟩ = ⟨x, adjoint(y)⟩, because the projection is linear in the data."""
    volumes, poses, weights, _ = scene(sparse)
    data = volumes[0].data.clone().requires_grad_()
    product = (project([volumes[0].with_data(data)], poses[:, :1], CAMERA).double() * weights).sum()
    product.backward()
    assert_close((data.double() * data.grad).sum(), product, rtol=0, atol=1e-7 * weights.abs().sum().item())


def test_two_runs_of_the_gradient_agree_bit_for_bit():
    volumes, poses, weights, _ = scene()
    gradients = []
    for _ in range(2):
        data, moving = volumes[0].data.clone().requires_grad_(), poses[:, :1].clone().requires_grad_()
        (project([volumes[0].with_data(data)], moving, CAMERA) * weights).sum().backward()
        gradients.append((data.grad, moving.grad))
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_gradients_are_zero_where_nothing_is_seen():
    volume = centred(torch.ones(10, 10, 10, requires_grad=True))
    pose = facing(x_mm=400.0).requires_grad_()
    project([volume], pose, CAMERA).sum().backward()
    assert not pose.grad.any()
    assert not volume.data.grad.any()
