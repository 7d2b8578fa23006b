"""The one public projector: line integrals through posed volumes, differentiable, on whichever back end fits."""

import functools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from femoreg_torch.drr import cpu, cuda
from femoreg_torch.drr.bricks import bricked
from femoreg_torch.drr.moments import affine_gradient, offset_gradient, unit_rays
from femoreg_torch.drr.reference import march
from femoreg_torch.drr.sampling import middle_index, middle_of, offset_rates, offsets_of
from femoreg_torch.errors import InputError
from femoreg_torch.geometry.camera import Camera
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.volume.grid import Volume

Array = NDArray[np.float64]


def project(
    volumes: Volume | Sequence[Volume],
    camera_from_volume: Tensor,
    camera: Camera,
    step_mm: float = 1.0,
    *,
    separate: bool = False,
) -> Tensor:
    """Line integrals of attenuation through one or several volumes, for a batch of poses.

    `camera_from_volume` maps the mm space of the volume (LPS or CAD) into the camera frame: (B, 4, 4) of one volume, or
    (B, V, 4, 4) of a sequence of V volumes.
    Values are interpolated trilinearly, are zero outside, and are summed along each ray every `step_mm`, times the
    step; samples are counted from the middle of each volume (`drr.sampling`). Returns (B, H, W) float32, summed over
    volumes, or (B, V, H, W) if `separate`.

    Differentiable in `camera_from_volume` and in the volumes' data. Compiled kernels that skip empty space do the work,
    on the device of the volumes: numba's on the CPU, Triton's on CUDA. Poses may lie there or on the CPU: neither waits
    for the device. Where Triton cannot (`cuda.why_not` tells), the slow plain-torch march steps in, with
    a warning that says why. A sub-window or a coarser grid is a matter of the camera (`Camera.window`,
    `Camera.downsampled`). Raises `InputError` where shapes or devices do not fit, and for poses that are not finite;
    poses on CUDA give an image of nan then, where to look at them would mean to wait.
    """
    if isinstance(volumes, Volume):
        if camera_from_volume.shape[1:] != (4, 4):
            raise InputError(
                f"project: one volume needs poses of shape (B, 4, 4), got {tuple(camera_from_volume.shape)}."
            )
        volumes, camera_from_volume = [volumes], camera_from_volume[:, None]
    _check(volumes, camera_from_volume)
    images = [_project_one(volume, camera_from_volume[:, v], camera, step_mm) for v, volume in enumerate(volumes)]
    if separate:
        return torch.stack(images, 1)
    return functools.reduce(torch.add, images)


def project_with_jacobian(
    volume: Volume,
    camera_from_volume: Tensor,
    camera: Camera,
    centre: Tensor,
    step_mm: float = 1.0,
    *,
    intrinsics: bool = False,
) -> tuple[Tensor, Tensor]:
    """Images (B, H, W) of one volume and their derivatives (B, H, W, 6) with respect to a twist in the camera frame.

    The twist moves the object after its pose: about `centre` (3,) in mm in the camera frame, along the camera's axes,
    (rotation in rad, translation in mm), taken at zero. With `intrinsics`, three more columns (B, H, W, 9) are the
    derivatives by the intrinsics: the logarithm of the source distance, and the principal point along x and y in mm on
    the detector. In memory the derivatives lie image by image, not pixel by pixel. `camera_from_volume` is (B, 4, 4).
    On the CPU, or on CUDA with Triton; raises `InputError` where it cannot.
    """
    _check([volume], camera_from_volume[:, None])
    with torch.no_grad():
        index_from_camera = _index_from_camera(volume, camera_from_volume)
        affines = index_from_camera[:, :3]
        middle = middle_of(volume, camera_from_volume)
        generators = _twist_generators(centre.to(index_from_camera))
        velocities = (generators[:, :3, :3] @ middle[:, None, :, None])[..., 0] + generators[:, :3, 3]  # (B, 6, 3)
        rates = offset_rates(middle, velocities)
        # To move the object is to move the camera's points in it the other way.
        changes = -affines[:, None] @ generators
        if intrinsics:
            by_rays = _ray_generators(camera).to(index_from_camera.device, non_blocking=True)
            changes = torch.cat([changes, affines[:, None] @ by_rays], 1)
            rates = torch.nn.functional.pad(rates, (0, 4))
    numbers = affines, changes, rates, offsets_of(middle, step_mm)
    affines, changes, rates, offsets = (n.to(volume.data.device, non_blocking=True) for n in numbers)
    image, planes = _with_derivatives(volume, affines, changes, rates, camera, offsets, step_mm)
    if intrinsics:
        rays = unit_rays(camera, image.device)
        turned, stretched = planes[:, 6:9], planes[:, 9:]
        generators = _ray_generators(camera)[:3, :3, :3].to(torch.float32).to(image.device, non_blocking=True)
        shares = torch.einsum("hwi,nij,hwj->nhw", rays, generators, rays)
        planes = torch.cat([planes[:, :6], turned - shares * stretched], 1)
    return image, planes.movedim(1, -1)


def _with_derivatives(
    volume: Volume, affines: Tensor, changes: Tensor, rates: Tensor, camera: Camera, offsets: Tensor, step_mm: float
) -> tuple[Tensor, Tensor]:
    """Images (B, H, W) and their derivatives (B, n, H, W) by parameters that change the affines by (B, n, 3, 4).

    Samples stay whole steps beyond `offsets` (B,) mm, which change by `rates` (B, n).
    """
    if volume.data.device.type == "cpu":
        numbers = affines.numpy(), camera, offsets.numpy(), step_mm
        integrals, moments = cpu.projection_with_moments(bricked(volume), *numbers)
        slides = rates[:, :, None, None] * affines[:, None, :, :3]
        planes = cpu.jacobian(moments, camera, changes.numpy(), slides.numpy())
        return torch.from_numpy(integrals), torch.from_numpy(planes)
    if reason := cuda.why_not(volume):
        raise InputError(f"project_with_jacobian: {reason}. Move the volume to the CPU, or use Triton on CUDA.")
    image, derivatives = cuda.jacobian(volume, affines, changes, camera, offsets, step_mm)
    along = -(derivatives[..., 3:6] * unit_rays(camera, image.device)).sum(-1, keepdim=True)
    moved = derivatives + rates.to(torch.float32)[:, None, None] * along
    return image, moved.movedim(-1, 1)


def _twist_generators(centre: Tensor) -> Tensor:
    """Derivatives (6, 4, 4) at zero of the motion by a twist about `centre` (3,), for each entry of the twist."""
    axes = torch.eye(3, dtype=centre.dtype, device=centre.device)
    generators = centre.new_zeros(6, 4, 4)
    generators[:3, :3, :3] = skew(axes)
    generators[:3, :3, 3] = -skew(axes) @ centre
    generators[3:, :3, 3] = axes
    return generators


def _ray_generators(camera: Camera) -> Tensor:
    """How the rays change with the intrinsics, and a stretch: (4, 4, 4) float64.

    The ray through a pixel runs along w = (x, y, f) with the source distance f. It changes by M w: M = e_z e_zᵀ with
    log f, and −e_x e_zᵀ / f and −e_y e_zᵀ / f with the principal point. Samples lie along the unit vector u = w / |w|,
    which changes by M u − (uᵀ M u) u; the last part is that of the stretch, M = 1.
    """
    generators = torch.zeros(4, 4, 4, dtype=torch.float64)
    generators[0, 2, 2] = 1
    generators[1, 0, 2] = generators[2, 1, 2] = -1 / camera.sdd_mm
    generators[3, :3, :3] = torch.eye(3)
    return generators


def _check(volumes: Sequence[Volume], camera_from_volume: Tensor) -> None:
    if camera_from_volume.ndim != 4 or camera_from_volume.shape[1:] != (len(volumes), 4, 4):
        raise InputError(
            f"project: {len(volumes)} volumes need poses of shape (B, {len(volumes)}, 4, 4), "
            f"got {tuple(camera_from_volume.shape)}."
        )
    if len({volume.data.device for volume in volumes}) > 1:
        raise InputError("project: the volumes lie on different devices. Move them to one.")
    if camera_from_volume.device.type == "cpu" and not torch.isfinite(camera_from_volume).all():
        raise InputError("project: a pose holds values that are not finite.")


def _index_from_camera(volume: Volume, camera_from_volume: Tensor) -> Tensor:
    """(B, 4, 4) float64 from mm in the camera frame to (x, y, z) indices, where the poses are."""
    device = camera_from_volume.device
    lps_from_index = volume.lps_from_index.to(device, non_blocking=True)
    camera_from_index = camera_from_volume.to(torch.float64) @ lps_from_index
    # To check for singular matrices means to wait for the device, so that only the CPU does.
    return torch.linalg.inv_ex(camera_from_index, check_errors=device.type == "cpu").inverse


def _project_one(volume: Volume, camera_from_volume: Tensor, camera: Camera, step_mm: float) -> Tensor:
    on_cpu = volume.data.device.type == "cpu"
    wanted = torch.is_grad_enabled() and (volume.data.requires_grad or camera_from_volume.requires_grad)
    if on_cpu and not wanted and camera_from_volume.device.type == "cpu":
        placed, first = _numbers_of(volume, camera_from_volume.detach().numpy(), step_mm)
        return torch.from_numpy(cpu.projection(bricked(volume), placed, camera, first, step_mm))
    index_from_camera = _index_from_camera(volume, camera_from_volume)
    index_from_camera = index_from_camera.to(volume.data.device, non_blocking=True)
    offsets = offsets_of(middle_of(volume, camera_from_volume), step_mm).to(volume.data.device, non_blocking=True)
    affines = index_from_camera[:, :3]
    if on_cpu:
        image: Tensor = _CpuProjection.apply(volume.data, affines, offsets, volume, camera, step_mm)
        return image
    if reason := cuda.why_not(volume):
        _warn_of_the_march(reason)
        return march(volume.data, index_from_camera.to(torch.float32), camera, offsets, step_mm)
    return cuda.project(volume, affines, camera, offsets, step_mm)


def _numbers_of(volume: Volume, poses: Array, step_mm: float) -> tuple[Array, Array]:
    """Index from camera (B, 3, 4) and offsets (B,) mm for poses (B, 4, 4), where no gradient is asked for.

    In numpy, because torch's calls take longer, by a twentieth of the time of a small image.
    """
    camera_from_index = poses.astype(np.float64) @ volume.lps_from_index.numpy()
    middles = (camera_from_index @ middle_index(volume))[:, :3]
    return np.linalg.inv(camera_from_index)[:, :3], np.linalg.norm(middles, axis=-1) % step_mm


@functools.cache
def _warn_of_the_march(reason: str) -> None:
    """Once per reason, not once per image."""
    warnings.warn(f"project: {reason}. The plain-torch march steps in, which is far slower.", stacklevel=4)


class _CpuProjection(torch.autograd.Function):
    """The CPU kernels as an autograd function of volume data, index-from-camera affines (B, 3, 4), offsets (B,)."""

    @staticmethod
    def forward(
        ctx: Any, data: Tensor, affines: Tensor, offsets: Tensor, volume: Volume, camera: Camera, step_mm: float
    ) -> Tensor:
        ctx.volume, ctx.camera, ctx.step_mm = volume, camera, step_mm
        numbers, moments = (affines.detach().numpy(), camera, offsets.detach().numpy(), step_mm), None
        if ctx.needs_input_grad[1]:  # one walk along the rays gives image and derivatives
            image, moments = cpu.projection_with_moments(bricked(volume), *numbers)
        else:
            image = cpu.projection(bricked(volume), *numbers)
        ctx.save_for_backward(affines, offsets, None if moments is None else torch.from_numpy(moments))
        return torch.from_numpy(image)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        affines, offsets, moments = ctx.saved_tensors
        weights = upstream.to(torch.float32)
        by_data = by_affines = by_offsets = None
        if ctx.needs_input_grad[0]:
            numbers = affines.detach().numpy(), ctx.camera, offsets.detach().numpy(), ctx.step_mm
            by_data = torch.from_numpy(cpu.volume_gradient(bricked(ctx.volume), *numbers, weights.contiguous().numpy()))
        if moments is not None:
            by_affines = affine_gradient(moments, ctx.camera, weights)
            by_offsets = offset_gradient(moments, affines, ctx.camera, weights)
        return by_data, by_affines, by_offsets, None, None, None
