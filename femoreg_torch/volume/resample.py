"""Other grids for the same volume: crops and isotropic resampling, with the affine that belongs to each."""

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.arrays import check_voxels
from femoreg_torch.errors import InputError
from femoreg_torch.volume.grid import Volume


def crop(volume: Volume, lo_xyz: tuple[int, int, int], hi_xyz: tuple[int, int, int]) -> Volume:
    """The voxels with `lo_xyz` ≤ (x, y, z) < `hi_xyz`, clipped to the grid. Raises `InputError` if none is left."""
    lo = [max(0, n) for n in lo_xyz]
    hi = [min(size, n) for size, n in zip(reversed(volume.data.shape), hi_xyz, strict=True)]
    if any(a >= b for a, b in zip(lo, hi, strict=True)):
        raise InputError(
            f"volume: the crop from {lo_xyz} to {hi_xyz} holds no voxel of a grid {tuple(volume.data.shape)[::-1]}."
        )
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3] @ torch.tensor(lo, dtype=torch.float64)
    return Volume(volume.data[lo[2] : hi[2], lo[1] : hi[1], lo[0] : hi[0]].contiguous(), affine)


def _nearest(size: int, scale: float) -> Tensor:
    """Which of `size` voxels along one axis each of the new ones lies in."""
    index = torch.arange(size, dtype=torch.float64)
    return F.interpolate(index[None, None], scale_factor=scale, mode="nearest-exact")[0, 0].long()


def _resize(data: Tensor, scale: tuple[float, float, float], nearest: bool) -> Tensor:
    """`data` (Z, Y, X) with `scale` = new over old number of voxels along x, y, z; outer faces stay where they are."""
    x, y, z = scale
    if nearest:  # by index, as torch interpolates few of the integer types
        k, j, i = (_nearest(n, s) for n, s in zip(data.shape, (z, y, x), strict=True))
        return data[k][:, j][:, :, i]
    # torch has the anti-aliased linear filter (a triangle as wide as the coarser voxel) in 2-D only; it is separable
    flat = F.interpolate(data[:, None], scale_factor=(y, x), mode="bilinear", antialias=True)[:, 0]
    upright = flat.movedim(0, 1)[:, None]  # (Y, 1, Z, X)
    return (
        F.interpolate(upright, scale_factor=(z, 1.0), mode="bilinear", antialias=True)[:, 0].movedim(1, 0).contiguous()
    )


def resample_isotropic(volume: Volume, spacing_mm: float, nearest: bool = False) -> Volume:
    """The volume on cubic voxels of `spacing_mm`, along its own axes.

    The outer face of the first voxel stays in place; a voxel that would reach beyond the far face is left out. Linear
    interpolation, with averaging where voxels become larger; `nearest` is for label maps. Raises `InputError` if the
    new voxels are larger than the volume, or more than can be worked with.
    """
    old = volume.spacing_mm
    if all(abs(s - spacing_mm) < 1e-6 for s in old):
        return volume
    ratio = torch.tensor([spacing_mm / s for s in old], dtype=torch.float64)
    scale = tuple((s + 1e-9) / spacing_mm for s in old)
    if any(int(n * s) < 1 for n, s in zip(reversed(volume.data.shape), scale, strict=True)):
        raise InputError(f"volume: {spacing_mm:g} mm voxels are larger than the whole volume.")
    size = [int(n * s) for n, s in zip(reversed(volume.data.shape), scale, strict=True)]
    extent = " × ".join(f"{n * s:.0f}" for n, s in zip(reversed(volume.data.shape), old, strict=True))
    check_voxels(size, f"volume of {extent} mm on voxels of {spacing_mm:g} mm", "Check its spacing, or crop it.")
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3] @ (0.5 * ratio - 0.5)
    affine[:3, :3] *= ratio
    return Volume(_resize(volume.data, (scale[0], scale[1], scale[2]), nearest), affine)


def sharpened(volume: Volume) -> Volume:
    """A volume whose voxels hold means over themselves, so that between them it is as sharp as what they are means of.

    The mean over a voxel of edge h (variance h² / 12 along each axis) and the interpolation between voxels (h² / 6)
    blur by a variance of h² / 4. To the order of h², a blur of variance σ² adds σ² / 2 times the second derivative, so
    that an eighth of the second differences is taken off. Beside edges the values overshoot. Zeros lie around the
    volume.
    """
    data = volume.data
    change = torch.zeros_like(data)
    for axis, size in enumerate(data.shape):
        differences = -2 * data
        differences.narrow(axis, 0, size - 1).add_(data.narrow(axis, 1, size - 1))
        differences.narrow(axis, 1, size - 1).add_(data.narrow(axis, 0, size - 1))
        change += differences
    return volume.with_data(data - change / 8)


def halved(volume: Volume) -> Volume:
    """The volume on voxels twice as large, each the mean of eight; what is missing at the far faces counts as zero."""
    data = F.pad(volume.data, [n for size in reversed(volume.data.shape) for n in (0, size % 2)])
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3].sum(1) / 2
    affine[:3, :3] *= 2
    return Volume(F.avg_pool3d(data[None].float(), 2)[0], affine)
