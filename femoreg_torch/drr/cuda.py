"""The projector on CUDA, by Triton: what the operator calls. No call waits for the device.

Without a GPU the same functions run on CPU tensors through Triton's interpreter (`TRITON_INTERPRET=1`), slowly: the
tests check the kernels in this way wherever they run.
"""

import functools
import importlib
import importlib.util
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.derivatives import first_order
from femoreg_torch.drr.bricks import RIM
from femoreg_torch.drr.device_bricks import bricked_on_device, padded_shape
from femoreg_torch.geometry.camera import Camera
from femoreg_torch.volume.grid import Volume

Array = NDArray[np.float64]

TILE = 8  # rays along the edge of a tile
WARPS = 1  # per tile, so that its rays agree on a leap without a barrier
_MOST_VOXELS = 2**31  # the kernels count voxels in int32


def why_not(volume: Volume) -> str | None:
    """Why these kernels cannot render a volume, in one line; None if they can."""
    device = volume.data.device
    if device.type != "cuda":
        return f"the volume is on {device}, not on a CUDA device"
    return why_no_kernels(device) or _too_large(volume)


def why_no_kernels(device: torch.device) -> str | None:
    """Why these kernels do not run on a CUDA device, in one line; None if they do."""
    return _no_triton() or _too_old(device)


@functools.cache
def _no_triton() -> str | None:
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    try:
        _kernels()
    except ImportError as error:
        return f"Triton cannot be imported: {error}"
    return None


def _too_old(device: torch.device) -> str | None:
    major, minor = torch.cuda.get_device_capability(device)
    return f"{device} has compute capability {major}.{minor}, Triton needs 7.0" if major < 7 else None


def _too_large(volume: Volume) -> str | None:
    depth, height, width = padded_shape(volume.data.shape)
    voxels = depth * height * width
    return f"the volume has {voxels} voxels with its rim, the kernels can count 2³¹" if voxels >= _MOST_VOXELS else None


def project(
    volume: Volume, affines: Tensor, camera: Camera, offsets: Tensor, step_mm: float, tile: int = TILE
) -> Tensor:
    """Line integrals (B, H, W) float32 of a volume for `affines` (B, 3, 4), index from camera mm.

    Samples lie whole steps beyond `offsets` (B,) mm. Differentiable in both (float64), and in the volume's data, which
    may be float16 or bfloat16: sums are float32 all the same. `affines` and `offsets` may lie on the CPU where they
    need no gradient. The gradient by `affines` is the same in every run, that by the data to rounding only (it needs
    atomics). A pose that is not finite gives an image of nan: to raise an error
    would mean to wait for the device. `tile` is a power of two: the rays along the edge of a tile, which leap together.
    """
    image: Tensor = _Projection.apply(volume.data, affines, offsets, volume, camera, step_mm, tile)
    return image


def jacobian(
    volume: Volume,
    affines: Array,
    changes: Array,
    rates: Array,
    camera: Camera,
    offsets: Array,
    step_mm: float,
    tile: int = TILE,
) -> tuple[Tensor, Tensor]:
    """Line integrals (B, H, W) and their derivatives (B, n, H, W).

    `changes` (B, n, 3, 4) are the derivatives of `affines` (B, 3, 4) with respect to the n parameters.
    Samples stay whole steps beyond `offsets` (B,) mm, which change by `rates` (B, n). `tile` is as for `project`.
    """
    image = volume.data.new_empty((len(affines), *camera.shape), dtype=torch.float32)
    derivatives = image.new_empty((len(affines), changes.shape[1], *camera.shape))
    placed, first, *moved = (torch.from_numpy(numbers) for numbers in (affines, offsets, changes, rates))
    outputs = (changes.shape[1], image, derivatives)
    _launch(_kernels().jacobian, _contents(volume), volume, placed, camera, first, step_mm, tile, outputs, moved)
    return image, derivatives


class _Projection(torch.autograd.Function):
    """The kernels as an autograd function of the volume's data and of index-from-camera affines (B, 3, 4)."""

    @staticmethod
    def forward(
        ctx: Any,
        data: Tensor,
        affines: Tensor,
        offsets: Tensor,
        volume: Volume,
        camera: Camera,
        step_mm: float,
        tile: int,
    ) -> Tensor:
        ctx.volume, ctx.camera, ctx.step_mm, ctx.tile = volume, camera, step_mm, tile
        image = data.new_empty((len(affines), *camera.shape), dtype=torch.float32)
        _launch(_kernels().forward, _contents(volume), volume, affines, camera, offsets, step_mm, tile, (image,))
        ctx.save_for_backward(affines, offsets)
        return image

    @staticmethod
    @first_order("an image of `project`")
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        affines, offsets = ctx.saved_tensors
        scene = (ctx.volume, affines, ctx.camera, offsets, ctx.step_mm, ctx.tile)
        weights = upstream.to(torch.float32).contiguous()
        data_gradient = affine_gradient = by_offsets = None
        if ctx.needs_input_grad[0]:
            shape = ctx.volume.data.shape
            padded = weights.new_zeros(padded_shape(shape))
            _launch(_kernels().volume_gradient, (), *scene, (weights, padded))
            data_gradient = padded[tuple(slice(RIM, RIM + n) for n in shape)]
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[2]:
            parts = affines.new_empty((len(affines), _tiles(ctx.camera, ctx.tile), 13))
            _launch(_kernels().pose_gradient, _contents(ctx.volume), *scene, (weights, parts))
            sums = parts.sum(1)
            affine_gradient, by_offsets = sums[:, :12].unflatten(1, (3, 4)), sums[:, 12]
        return data_gradient, affine_gradient, by_offsets, None, None, None, None


@functools.cache
def _kernels() -> ModuleType:
    return importlib.import_module("femoreg_torch.drr.triton_kernels")


def _tiles(camera: Camera, tile: int) -> int:
    rows, columns = camera.shape
    return -(-rows // tile) * -(-columns // tile)


def _contents(volume: Volume) -> tuple[Tensor, Tensor]:
    bricks = bricked_on_device(volume)
    return bricks.padded, bricks.leap


def _launch(
    kernel: Any,
    contents: tuple[Tensor, ...],
    volume: Volume,
    affines: Tensor,
    camera: Camera,
    offsets: Tensor,
    step_mm: float,
    tile: int,
    outputs: tuple[Tensor | int, ...],
    moved: Sequence[Tensor] = (),
) -> None:
    """Run a kernel, one program per tile and pose; all take these arguments in this order.

    What lies on the CPU of `affines`, `offsets` and `moved` goes to the device by one copy.
    """
    geometry = torch.tensor([camera.sdd_mm, *camera.pixel_mm, *camera.principal_point_px, step_mm], dtype=torch.float64)
    padded_affines = affines.detach().to(torch.float64, memory_format=torch.contiguous_format, copy=True)
    padded_affines[:, :, 3] += RIM
    poses = [padded_affines, offsets.detach().to(torch.float64), *moved]
    geometry, padded_affines, offsets, *moved = _on_the_device([geometry, *poses], volume.data.device)
    with torch.cuda.device_of(volume.data):  # Triton launches on the current device
        kernel[(_tiles(camera, tile), len(affines))](
            *contents,
            padded_affines,
            geometry,
            offsets,
            *padded_shape(volume.data.shape),
            *camera.shape,
            *moved,
            *outputs,
            tile=tile,
            num_warps=WARPS,
            enable_fp_fusion=True,
        )


def _on_the_device(numbers: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Float64 numbers in the order in which they lie in memory, there; those of the CPU by one copy."""
    here = [each for each in numbers if each.device.type == "cpu"]
    flat = torch.cat([each.flatten() for each in here]).to(device, non_blocking=True)
    arrived = iter(flat.split([each.numel() for each in here]))
    return [next(arrived) if each.device.type == "cpu" else each.contiguous() for each in numbers]
