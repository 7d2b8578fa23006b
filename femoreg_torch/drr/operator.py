"""The one public projector: line integrals through posed volumes, differentiable, on whichever back end fits."""

import functools
import math
import warnings
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.derivatives import first_order
from femoreg_torch.drr import cpu, cuda
from femoreg_torch.drr.bricks import bricked
from femoreg_torch.drr.moments import affine_gradient, offset_gradient, unit_rays
from femoreg_torch.drr.reference import march
from femoreg_torch.drr.sampling import middle_index, middle_of, offsets_of
from femoreg_torch.errors import InputError, in_mm, shortened
from femoreg_torch.geometry.camera import Camera
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.volume.grid import Volume

Array = NDArray[np.float64]

# Samples along the diagonal of a volume: several hundred per voxel of the largest CTs. One image of a million takes
# minutes, and more are a step or an affine in the wrong unit.
_MOST_SAMPLES = 1e6
# Voxels per mm, and voxels from the source to the first one, to which float64 still tells a thousandth of a voxel. The
# inverse of a pose that is singular, or lies out of this world, has more, or nan.
_MOST_VOXELS = 1e12
_LAST_ROW, _ROUNDING = np.array([0.0, 0.0, 0.0, 1.0]), 1e-4  # poses may be float16
_SPINS = skew(torch.eye(3, dtype=torch.float64)).numpy()  # about each axis
_NO_DISTANCE = 1e-12  # mm from the source: of a volume whose middle lies in it


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
    `Camera.downsampled`).

    The derivative is of first order: the image cannot be differentiated twice, and `torch.func.grad`, `jacrev`,
    `jacfwd` and `vmap` do not go through it; `project_with_jacobian` gives all derivatives by a pose at once. Images
    are float32 whatever comes in, so a check by finite differences needs steps of some 1e-3 rad and mm.

    Raises `InputError` where shapes or devices do not fit, for a step that is not positive or so short that a ray takes
    more than a million samples through a volume, and for poses that are not finite, singular, or not affine (last row
    0, 0, 0, 1). Poses on CUDA of a volume there give an image of nan instead, where to look at them would mean to wait.
    """
    if isinstance(volumes, Volume):
        _check_tensor(camera_from_volume)
        if camera_from_volume.ndim != 3 or camera_from_volume.shape[1:] != (4, 4):
            raise InputError(
                f"project: one volume needs poses of shape (B, 4, 4), got {tuple(camera_from_volume.shape)}."
            )
        volumes, camera_from_volume = [volumes], camera_from_volume[:, None]
    _check(volumes, camera_from_volume, camera, step_mm)
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
    the detector. In memory the derivatives lie image by image, not pixel by pixel. `camera_from_volume` is (B, 4, 4);
    poses that lie on a device are waited for.
    On the CPU, or on CUDA with Triton; raises `InputError` where it cannot, and as `project` does.
    """
    _check_tensor(camera_from_volume)
    if camera_from_volume.ndim != 3:
        raise InputError(
            f"project_with_jacobian: poses of shape (B, 4, 4) are needed, got {tuple(camera_from_volume.shape)}."
        )
    _check([volume], camera_from_volume[:, None], camera, step_mm)
    if centre.shape != (3,):
        raise InputError(f"project_with_jacobian: a centre of shape (3,) is needed, got {tuple(centre.shape)}.")
    poses = camera_from_volume.detach().to("cpu", torch.float64).numpy()
    affines, middles = _numbers_of(volume, poses, step_mm)
    generators = _twist_generators(centre.detach().to("cpu", torch.float64).numpy())
    velocities = (generators[:, :3, :3] @ middles[:, None, :, None])[..., 0] + generators[:, :3, 3]  # (B, 6, 3)
    distances = np.linalg.norm(middles, axis=-1)
    rates = (velocities @ middles[..., None])[..., 0] / np.maximum(distances, _NO_DISTANCE)[:, None]
    # To move the object is to move the camera's points in it the other way.
    changes = -affines[:, None] @ generators
    if intrinsics:
        changes = np.concatenate([changes, affines[:, None] @ _ray_generators(camera)], 1)
        rates = np.pad(rates, ((0, 0), (0, 4)))
    offsets = distances % step_mm
    image, planes = _with_derivatives(volume, affines, changes, rates, camera, offsets, step_mm)
    if intrinsics:
        rays = unit_rays(camera, image.device)
        turned, stretched = planes[:, 6:9], planes[:, 9:]
        bent = torch.from_numpy(_ray_generators(camera)[:3, :3, :3]).float().to(image.device, non_blocking=True)
        shares = torch.einsum("hwi,nij,hwj->nhw", rays, bent, rays)
        planes = torch.cat([planes[:, :6], turned - shares * stretched], 1)
    return image, planes.movedim(1, -1)


def _with_derivatives(
    volume: Volume, affines: Array, changes: Array, rates: Array, camera: Camera, offsets: Array, step_mm: float
) -> tuple[Tensor, Tensor]:
    """Images (B, H, W) and their derivatives (B, n, H, W) by parameters that change the affines by (B, n, 3, 4).

    Samples stay whole steps beyond `offsets` (B,) mm, which change by `rates` (B, n).
    """
    if volume.data.device.type == "cpu":
        integrals, moments = cpu.projection_with_moments(bricked(volume), affines, camera, offsets, step_mm)
        slides = rates[:, :, None, None] * affines[:, None, :, :3]
        return torch.from_numpy(integrals), torch.from_numpy(cpu.jacobian(moments, camera, changes, slides))
    if reason := cuda.why_not(volume):
        raise InputError(f"project_with_jacobian: {reason}. Move the volume to the CPU, or use Triton on CUDA.")
    return cuda.jacobian(volume, affines, changes, rates, camera, offsets, step_mm)


def _twist_generators(centre: Array) -> Array:
    """Derivatives (6, 4, 4) at zero of the motion by a twist about `centre` (3,), for each entry of the twist."""
    generators = np.zeros((6, 4, 4))
    generators[:3, :3, :3] = _SPINS
    generators[:3, :3, 3] = -_SPINS @ centre
    generators[3:, :3, 3] = np.eye(3)
    return generators


def _ray_generators(camera: Camera) -> Array:
    """How the rays change with the intrinsics, and a stretch: (4, 4, 4).

    The ray through a pixel runs along w = (x, y, f) with the source distance f. It changes by M w: M = e_z e_zᵀ with
    log f, and −e_x e_zᵀ / f and −e_y e_zᵀ / f with the principal point. Samples lie along the unit vector u = w / |w|,
    which changes by M u − (uᵀ M u) u; the last part is that of the stretch, M = 1.
    """
    generators = np.zeros((4, 4, 4))
    generators[0, 2, 2] = 1
    generators[1, 0, 2] = generators[2, 1, 2] = -1 / camera.sdd_mm
    generators[3, :3, :3] = np.eye(3)
    return generators


def _check_tensor(camera_from_volume: Tensor) -> None:
    if not isinstance(camera_from_volume, Tensor):
        found = type(camera_from_volume).__name__
        raise InputError(f"project: poses must be a torch tensor, got {found}. Use torch.as_tensor.")
    if camera_from_volume.is_complex():
        raise InputError("project: poses must be real, got complex numbers.")


def _check(volumes: Sequence[Volume], camera_from_volume: Tensor, camera: Camera, step_mm: float) -> None:
    _check_tensor(camera_from_volume)
    if not isinstance(volumes, Sequence) or not all(isinstance(volume, Volume) for volume in volumes):
        raise InputError(f"project: a Volume or a list of them is needed, got {type(volumes).__name__}.")
    if not volumes:
        raise InputError("project: there is no volume to project, the list is empty.")
    if not isinstance(camera, Camera):
        raise InputError(f"project: a Camera is needed, got {type(camera).__name__}.")
    if not isinstance(step_mm, float | Real) or not 0 < step_mm < math.inf:
        raise InputError(f"project: step_mm must be positive and finite, got {shortened(step_mm)}.")
    if camera_from_volume.ndim != 4 or camera_from_volume.shape[1:] != (len(volumes), 4, 4):
        raise InputError(
            f"project: {len(volumes)} volumes need poses of shape (B, {len(volumes)}, 4, 4), "
            f"got {tuple(camera_from_volume.shape)}."
        )
    if len({volume.data.device for volume in volumes}) > 1:
        raise InputError("project: the volumes lie on different devices. Move them to one.")
    if camera_from_volume.device.type == "cpu":
        poses = camera_from_volume.detach().to(torch.float64).numpy()
        if not np.isfinite(poses).all():
            raise InputError("project: a pose holds values that are not finite.")
        last = poses[..., 3, :]
        if not (last == _LAST_ROW).all() and not (np.abs(last - _LAST_ROW) <= _ROUNDING).all():
            raise InputError("project: the last row of a pose must be 0, 0, 0, 1.")


def _check_samples(volume: Volume, camera_from_index: Array, step_mm: float) -> None:
    """Raise `InputError` if rays take too many samples through a volume; of (B, 4, 4) linear parts (3, 3) count.

    The box of a volume, in mm along the axes of the camera, is as long as the sum of its edges there.
    """
    depth, height, width = volume.data.shape
    along = np.abs(camera_from_index[:, :3, :3]) @ (width + 1.0, height + 1.0, depth + 1.0)  # (B, 3)
    longest = float(along.max(initial=0.0))
    if longest > _MOST_SAMPLES * step_mm:
        raise InputError(
            f"project: a ray takes {longest / step_mm:.2g} samples through a volume of {in_mm(longest)} at step_mm = "
            f"{step_mm:g}; {_MOST_SAMPLES:g} are the limit. Take longer steps, and give affines in mm."
        )


def _check_inverse(index_from_camera: Array) -> None:
    """Raise `InputError` for affines (B, 3, 4) that the CPU's kernels cannot follow. They would read anywhere."""
    if not (np.abs(index_from_camera) <= _MOST_VOXELS).all():
        raise InputError(
            "project: a pose is not finite, has no inverse, or puts its volume out of reach. Give rigid poses in mm."
        )


def _index_from_camera(volume: Volume, camera_from_volume: Tensor, step_mm: float) -> Tensor:
    """(B, 4, 4) float64 from mm in the camera frame to (x, y, z) indices, where the poses are."""
    device = camera_from_volume.device
    lps_from_index = volume.lps_from_index.to(device, non_blocking=True)
    camera_from_index = camera_from_volume.to(torch.float64) @ lps_from_index
    inverse, fault = torch.linalg.inv_ex(camera_from_index)
    # To look at what lies on a device means to wait for it: there a rigid pose is taken for granted.
    on_cpu = device.type == "cpu"
    _check_samples(volume, (camera_from_index.detach() if on_cpu else volume.lps_from_index[None]).numpy(), step_mm)
    if on_cpu and fault.numpy().any():
        raise InputError("project: a pose has no inverse. Give rigid poses in mm.")
    return inverse


def _project_one(volume: Volume, camera_from_volume: Tensor, camera: Camera, step_mm: float) -> Tensor:
    on_cpu = volume.data.device.type == "cpu"
    reason = None if on_cpu else cuda.why_not(volume)
    wanted = torch.is_grad_enabled() and (volume.data.requires_grad or camera_from_volume.requires_grad)
    if not wanted and reason is None and camera_from_volume.device.type == "cpu":
        placed, middles = _numbers_of(volume, camera_from_volume.detach().numpy(), step_mm)
        first = np.linalg.norm(middles, axis=-1) % step_mm
        if on_cpu:
            return torch.from_numpy(cpu.projection(bricked(volume), placed, camera, first, step_mm))
        return cuda.project(volume, torch.from_numpy(placed), camera, torch.from_numpy(first), step_mm)
    index_from_camera = _index_from_camera(volume, camera_from_volume, step_mm)
    index_from_camera = index_from_camera.to(volume.data.device, non_blocking=True)
    offsets = offsets_of(middle_of(volume, camera_from_volume), step_mm).to(volume.data.device, non_blocking=True)
    affines = index_from_camera[:, :3]
    if on_cpu:
        _check_inverse(affines.detach().numpy())
        image: Tensor = _CpuProjection.apply(volume.data, affines, offsets, volume, camera, step_mm)
        return image
    if reason is not None:
        _warn_of_the_march(reason)
        return march(volume.data, index_from_camera.to(torch.float32), camera, offsets, step_mm)
    return cuda.project(volume, affines, camera, offsets, step_mm)


def _numbers_of(volume: Volume, poses: Array, step_mm: float) -> tuple[Array, Array]:
    """Index from camera (B, 3, 4) and middles (B, 3) mm in the camera for poses (B, 4, 4), without their gradients.

    In numpy, because torch's calls take longer, by a twentieth of the time of a small image.
    """
    camera_from_index = poses.astype(np.float64) @ volume.lps_from_index.numpy()
    _check_samples(volume, camera_from_index, step_mm)
    middles = (camera_from_index @ middle_index(volume))[:, :3]
    try:
        affines = np.linalg.inv(camera_from_index)[:, :3]
    except np.linalg.LinAlgError as error:
        raise InputError("project: a pose has no inverse. Give rigid poses in mm.") from error
    _check_inverse(affines)
    return affines, middles


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
    @first_order("an image of `project`")
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
