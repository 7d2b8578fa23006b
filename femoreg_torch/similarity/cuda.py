"""Patch Grad-NCC on CUDA, by Triton: what `FixedGradNcc` calls. No call waits for the device.

Without a GPU the same functions run on CPU tensors through Triton's interpreter (`TRITON_INTERPRET=1`), slowly: the
tests check the kernels in this way wherever they run.
"""

import functools
import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from femoreg_torch.drr import cuda as projector
from femoreg_torch.similarity.kernels import FLAT

if TYPE_CHECKING:
    from femoreg_torch.similarity.grad_ncc import FixedGradNcc

_BLOCK = 128  # pixels or patches per program


def runs(images: Tensor) -> bool:
    """Whether these kernels take images: float32 on a CUDA device that Triton runs on."""
    on_device = images.device.type == "cuda" and images.dtype == torch.float32
    return on_device and projector.why_no_kernels(images.device) is None


def grad_ncc(images: Tensor, similarity: "FixedGradNcc") -> Tensor:
    """Weighted mean NCC (B,) float64 of images (B, H, W)."""
    images = images.contiguous()
    return _correlated(_derivatives(images, similarity.tap_tables), similarity, keep=False)[0]


def grad_ncc_and_gradient(images: Tensor, similarity: "FixedGradNcc") -> tuple[Tensor, Tensor]:
    """Weighted mean NCC (B,) float64 of images (B, H, W), and the gradient (B, H, W) of each by its image."""
    images, taps = images.contiguous(), similarity.tap_tables
    count, height, width = images.shape
    maps = _derivatives(images, taps)
    values, factors = _correlated(maps, similarity, keep=True)
    back, gradient = torch.empty_like(maps), torch.empty_like(images)
    numbers = (maps, similarity.fixed, factors, height, width, similarity.radius, back)
    _launch(_kernels().spread_back, _grid(height, width, 2 * count), *numbers, block=_BLOCK)
    transposed, last = _kernels().transposed_derivatives, {"count": taps.shape[-1], "block": _BLOCK}
    _launch(transposed, _grid(height, width, count), back, taps, height, width, gradient, **last)
    return values, gradient


def curvature(image: Tensor, changes: Tensor, similarity: "FixedGradNcc", stride: int) -> Tensor:
    """Gauss–Newton hessian (n, n) float64 about an image (H, W) with changes (n, H, W); every stride-th patch."""
    (height, width), radius, taps = image.shape, similarity.radius, similarity.tap_tables
    rows, columns = ((n - 2 * radius - 1) // stride + 1 for n in (height, width))
    moving, maps = _derivatives(image.contiguous()[None], taps), _derivatives(changes.contiguous(), taps)
    mean, of_mean, of_along = (image.new_empty((2, rows, columns)) for _ in range(3))
    totals, along = (image.new_empty((len(changes), 2, rows, columns)) for _ in range(2))
    root = image.new_empty((2, height, width))
    size = (height, width, radius, stride)
    fixed = (similarity.fixed, similarity.scale, similarity.weights)
    kernels, patches = _kernels(), _grid(rows, columns, 2)
    _launch(kernels.shares, patches, moving, *fixed, *size, FLAT, mean, of_mean, of_along, block=_BLOCK)
    _launch(kernels.cover, _grid(height, width, 2), of_mean, *size, root, block=_BLOCK)
    every = _grid(rows, columns, 2 * len(changes))
    _launch(kernels.patch_factors, every, maps, moving, mean, of_mean, of_along, *size, totals, along, block=_BLOCK)
    of_pixels, of_means, of_along = (factor.flatten(1) for factor in (maps.mul_(root), totals, along))
    both = of_pixels @ of_pixels.T - of_means @ of_means.T - of_along @ of_along.T
    # the cost is the mean over both derivatives, and weights are those of every patch
    return both.to(torch.float64) / (2 * similarity.weights[::stride, ::stride].sum())


def tile_sums(changes: Tensor, slope: Tensor, tile: int) -> Tensor:
    """Sums (n, T) float64 of changes (n, H, W) times slope (H, W) over square tiles, row by row of tiles."""
    count, height, width = changes.shape
    down, across = -(-height // tile), -(-width // tile)
    out = changes.new_empty((count, down * across), dtype=torch.float64)
    numbers = (changes.contiguous(), slope.contiguous(), height, width, tile, across, out)
    block = 1 << (tile - 1).bit_length()
    _launch(_kernels().tile_sums, (down * across, count), *numbers, block=block)
    return out


def _derivatives(images: Tensor, taps: Tensor) -> Tensor:
    """Derivatives (B, 2, H, W) of images (B, H, W), along columns then along rows."""
    count, height, width = images.shape
    maps = images.new_empty((count, 2, height, width))
    numbers = (images, taps, height, width, maps)
    _launch(_kernels().derivatives, _grid(height, width, count), *numbers, count=taps.shape[-1], block=_BLOCK)
    return maps


def _correlated(maps: Tensor, similarity: "FixedGradNcc", *, keep: bool) -> tuple[Tensor, Tensor]:
    """Weighted mean NCC (B,) float64 of derivatives (B, 2, H, W), and what its gradient needs (B, 2, 3, patches)."""
    count, _, height, width = maps.shape
    rows, columns = similarity.weights.shape
    grid = _grid(rows, columns, 2 * count)
    parts = maps.new_empty((count, 2 * grid[0]), dtype=torch.float64)
    factors = maps.new_empty((count, 2, 3, rows, columns) if keep else (0,), dtype=torch.float64)
    fixed = (similarity.fixed, similarity.mean, similarity.scale, similarity.weights)
    numbers = (maps, *fixed, height, width, similarity.radius, FLAT, parts, factors)
    _launch(_kernels().correlate, grid, *numbers, keep=keep, block=_BLOCK)
    return parts.sum(1) / 2, factors


@functools.cache
def _kernels() -> ModuleType:
    return importlib.import_module("femoreg_torch.similarity.triton_kernels")


def _grid(rows: int, columns: int, count: int) -> tuple[int, int]:
    return -(-rows * columns // _BLOCK), count


def _launch(kernel: Any, grid: tuple[int, int], first: Tensor, *others: Tensor | float, **constants: int) -> None:
    with torch.cuda.device_of(first):  # Triton launches on the current device
        kernel[grid](first, *others, **constants, enable_fp_fusion=True)
