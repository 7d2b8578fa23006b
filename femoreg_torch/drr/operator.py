"""The one public projector: line integrals through posed volumes, differentiable, on whichever back end fits."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from femoreg_torch.drr import cpu
from femoreg_torch.drr.bricks import bricked
from femoreg_torch.drr.reference import march
from femoreg_torch.errors import InputError
from femoreg_torch.geometry.camera import Camera
from femoreg_torch.geometry.rigid import exp_se3
from femoreg_torch.volume.grid import Volume


def project(
    volumes: Sequence[Volume],
    camera_from_volume: Tensor,
    camera: Camera,
    step_mm: float = 1.0,
    *,
    separate: bool = False,
) -> Tensor:
    """Line integrals of attenuation through one or several volumes, for a batch of poses.

    `camera_from_volume` (B, V, 4, 4) maps the mm space of each of the V volumes (LPS or CAD) into the camera frame.
    Values are interpolated trilinearly, are zero outside, and are summed at whole multiples of `step_mm` along each ray
    from the source, times the step. Returns (B, H, W) float32, summed over volumes, or (B, V, H, W) if `separate`.

    Differentiable in `camera_from_volume` and in the volumes' data. On the CPU a compiled kernel that skips empty space
    does the work; on other devices the plain-torch reference does. A sub-window or a coarser grid is a matter of the
    camera (`Camera.window`, `Camera.downsampled`). Raises `InputError` where the shapes do not fit.
    """
    _check(volumes, camera_from_volume)
    images = [
        _project_one(volume, _index_from_camera(volume, camera_from_volume[:, v]), camera, step_mm)
        for v, volume in enumerate(volumes)
    ]
    return torch.stack(images, 1) if separate else torch.stack(images).sum(0)


def project_with_jacobian(
    volume: Volume, camera_from_volume: Tensor, camera: Camera, centre: Tensor, step_mm: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Images (B, H, W) of one volume and their derivatives (B, H, W, 6) with respect to a twist in the camera frame.

    The twist moves the object after its pose: about `centre` (3,) in mm in the camera frame, along the camera's axes,
    (rotation in rad, translation in mm), taken at zero. CPU only; `camera_from_volume` is (B, 4, 4).
    """
    _check([volume], camera_from_volume[:, None])

    def affines(twist: Tensor) -> Tensor:
        shift = torch.eye(4, dtype=torch.float64)
        shift[:3, 3] = centre
        moved = shift @ exp_se3(twist) @ torch.linalg.inv(shift) @ camera_from_volume.to(torch.float64)
        return _index_from_camera(volume, moved)[:, :3]

    zero = torch.zeros(6, dtype=torch.float64)
    changes = torch.autograd.functional.jacobian(affines, zero, vectorize=True)  # (B, 3, 4, 6)
    image, jacobian = cpu.jacobian(
        bricked(volume), affines(zero).numpy(), changes.permute(0, 3, 1, 2).numpy(), camera, step_mm
    )
    return torch.from_numpy(image), torch.from_numpy(jacobian)


def _check(volumes: Sequence[Volume], camera_from_volume: Tensor) -> None:
    if camera_from_volume.ndim != 4 or camera_from_volume.shape[1:] != (len(volumes), 4, 4):
        raise InputError(
            f"project: {len(volumes)} volumes need poses of shape (B, {len(volumes)}, 4, 4), "
            f"got {tuple(camera_from_volume.shape)}."
        )
    if not torch.isfinite(camera_from_volume).all():
        raise InputError("project: a pose holds values that are not finite.")


def _index_from_camera(volume: Volume, camera_from_volume: Tensor) -> Tensor:
    """(B, 4, 4) float64 from mm in the camera frame to (x, y, z) indices of the volume."""
    camera_from_index = camera_from_volume.to(torch.float64) @ volume.lps_from_index.to(camera_from_volume.device)
    return torch.linalg.inv(camera_from_index)


def _project_one(volume: Volume, index_from_camera: Tensor, camera: Camera, step_mm: float) -> Tensor:
    if volume.data.device.type == "cpu":
        image: Tensor = _CpuProjection.apply(volume.data, index_from_camera[:, :3], volume, camera, step_mm)
        return image
    return march(volume.data, index_from_camera.to(torch.float32), camera, step_mm)


class _CpuProjection(torch.autograd.Function):
    """The CPU kernels as an autograd function of the volume's data and of index-from-camera affines (B, 3, 4)."""

    @staticmethod
    def forward(ctx: Any, data: Tensor, affines: Tensor, volume: Volume, camera: Camera, step_mm: float) -> Tensor:
        ctx.save_for_backward(affines)
        ctx.volume, ctx.camera, ctx.step_mm = volume, camera, step_mm
        image = torch.zeros((len(affines), *camera.shape))
        cpu.add_projection(bricked(volume), affines.detach().numpy(), camera, step_mm, image.numpy())
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (affines,) = ctx.saved_tensors
        volume, camera, step_mm = bricked(ctx.volume), ctx.camera, ctx.step_mm
        weights, poses = upstream.to(torch.float32).contiguous().numpy(), affines.detach().numpy()
        data_gradient = affine_gradient = None
        if ctx.needs_input_grad[0]:
            data_gradient = torch.from_numpy(cpu.volume_gradient(volume, poses, camera, step_mm, weights))
        if ctx.needs_input_grad[1]:
            affine_gradient = torch.from_numpy(cpu.pose_gradient(volume, poses, camera, step_mm, weights))
        return data_gradient, affine_gradient, None, None, None
