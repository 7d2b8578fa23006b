"""Regions of a device: blocks of a solid, the paths of rays through them, and the few materials that they are of."""

import math
from dataclasses import dataclass

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from torch import Tensor

from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.volume import Volume

_BLOCK_MM = 6.0  # longest edge of a block of a solid whose parts nobody names
# Standard deviation of the logarithm of attenuation within one material, blocks being fitted so well. A solid of one
# material is common, and a second one would be the fit's noise; where there are several anyhow, they are told apart.
_SPREAD_OF_ONE, _SPREAD_OF_SEVERAL = 0.4, 0.2
_MOST_MATERIALS = 4
# Share of the blocks beside another material that are of that: a tenth to a third on three simulated devices. With an
# eighth, the stated deviations of 16 devices held 69 to 88 % of their errors, and twice them 94 to 100 %; without, 53
# to 87 and 80 to 100 %.
_TAKEN_FOR_ANOTHER = 0.125
_DRAWN_MISTAKES = 12
_LEAST_ATTENUATION = 0.01  # 1/mm: what is below is as good as air

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]


def blocks_of(solid: Volume) -> tuple[Tensor, int]:
    """A solid cut into blocks no longer than 6 mm: the number of the block of every voxel (Z, Y, X), and how many.

    Halved along the longest edge of what lies in a block, again and again, but never within a voxel. Empty voxels have
    the number −1.
    """
    spacing = np.array(solid.spacing_mm[::-1])
    owner, count, waiting = torch.full(solid.data.shape, -1), 0, [solid.data.nonzero().numpy()]
    while waiting:
        block = waiting.pop()
        extent = (np.ptp(block, axis=0) + 1) * spacing
        axis = int(extent.argmax())
        if extent[axis] <= max(_BLOCK_MM, spacing[axis]):
            owner[tuple(torch.from_numpy(block).T)] = count
            count += 1
            continue
        middle = (block[:, axis].min() + block[:, axis].max()) / 2
        waiting += [block[block[:, axis] <= middle], block[block[:, axis] > middle]]
    return owner, count


def touching_faces(owner: Tensor) -> Indices:
    """Pairs of regions that touch (n, 3): two numbers, and how many faces of voxels they share."""
    of, regions, found = owner.flatten().numpy(), int(owner.max()) + 1, []
    solid = np.flatnonzero(of >= 0)
    for axis, size in enumerate(owner.shape):
        stride = math.prod(owner.shape[axis + 1 :])
        first = solid[solid // stride % size < size - 1]
        a, b = of[first], of[first + stride]
        touching = (a != b) & (b >= 0)
        a, b = a[touching], b[touching]
        found.append(np.minimum(a, b) * regions + np.maximum(a, b))
    pairs, faces = np.unique(np.concatenate(found), return_counts=True)
    return np.column_stack([*np.divmod(pairs, regions), faces])


def filled(share: Volume, owner: Tensor, values: Doubles) -> Volume:
    """A volume of the `values` (K,) of regions: each voxel's share times that of its `owner` (Z, Y, X), 0 where −1."""
    inside = share.data.contiguous().numpy()
    return share.with_data(torch.from_numpy(_filled(inside, owner.contiguous().numpy(), values.astype(np.float32))))


@numba.njit(cache=True, nogil=True)
def _filled(share, owner, values):  # type: ignore[no-untyped-def]
    """Shares (Z, Y, X) times the value of each voxel's owner; 0 where that is −1."""
    of, shares, out = owner.reshape(-1), share.reshape(-1), np.zeros(share.size, np.float32)
    for voxel in range(share.size):
        if of[voxel] >= 0:
            out[voxel] = shares[voxel] * values[of[voxel]]
    return out.reshape(share.shape)


def mistakable(material: Indices, attenuation: Doubles, touching: Indices) -> tuple[Indices, Doubles]:
    """Blocks (n,) that may be of the material of a block that they touch, and by how much they would attenuate more.

    `material` numbers that of every block, with an `attenuation` each; `touching` are pairs of blocks, and faces.
    """
    pairs = np.concatenate([touching[:, :2], touching[:, 1::-1]])
    pairs = np.column_stack([pairs[:, 0], material[pairs[:, 1]]])
    block, other = np.unique(pairs[material[pairs[:, 0]] != pairs[:, 1]], axis=0).T
    return block, attenuation[other] - attenuation[material[block]]


@dataclass(frozen=True, eq=False)
class Borders:
    """Blocks of a solid whose materials were estimated."""

    blocks: Tensor  # (Z, Y, X): the block of every voxel, −1 where it is empty
    material: Indices  # of every block
    touching: Indices  # (n, 3): pairs of blocks, and the faces between them


def mistakes(share: Volume, borders: Borders, attenuation: Doubles) -> tuple[Volume, ...]:
    """Differences of attenuation, 1/mm: blocks that border on another material, taken for the wrong one of the two.

    `share` holds how much of every voxel is inside, `attenuation` that of the materials. All such blocks stand in each
    difference, up or down by chance, so that the squares of what the differences do to an image add up to those of what
    each block does (Hutchinson, Commun Stat Simul Comput 18 (1989) 1059). The chance is always the same, so that a
    result can be repeated.
    """
    block, more = mistakable(borders.material, attenuation, borders.touching)
    chance = np.random.default_rng(0)
    found = []
    for _ in range(_DRAWN_MISTAKES):
        amount = np.zeros(len(borders.material))
        np.add.at(amount, block, chance.choice([-1.0, 1.0], len(block)) * more)
        amount *= math.sqrt(_TAKEN_FOR_ANOTHER * (1 - _TAKEN_FOR_ANOTHER) / _DRAWN_MISTAKES)
        found.append(filled(share, borders.blocks, amount))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class RegionVoxels:
    """The voxels of a device that are not empty, region by region."""

    middles: Tensor  # (n, 3) mm in the device's space
    volumes: Tensor  # (n,) mm³ that are inside
    ends: Indices  # (K,): where the voxels of each region end


def region_voxels(share: Volume, owner: Tensor, count: int) -> RegionVoxels:
    """The voxels of `count` regions, told by `owner` (Z, Y, X), of a volume that holds the share of each in it."""
    where = share.data.nonzero()
    region = owner[where.unbind(1)].numpy()
    where = where[torch.from_numpy(np.argsort(region, kind="stable"))]
    return RegionVoxels(
        transform_points(share.lps_from_index, where.flip(1).double()),
        share.data[where.unbind(1)].double() * math.prod(share.spacing_mm),
        np.cumsum(np.bincount(region, minlength=count)),
    )


def region_paths(voxels: RegionVoxels, camera_from_volume: Tensor, camera: Camera) -> csr_array:
    """Paths in mm (H · W, K) of the rays through K regions.

    Every voxel adds its volume, per area of a pixel's shadow at its depth, to the four pixels around where it is seen.
    """
    points = transform_points(camera_from_volume, voxels.middles)
    pixels = project_points(camera, points)  # (n, 2) column, row
    slant = points[:, 2] / points.norm(dim=1)
    shadow = (points[:, 2] / camera.sdd_mm) ** 2 * camera.pixel_mm[0] * camera.pixel_mm[1] * slant
    rows, paths, begins = _gathered(pixels.numpy(), (voxels.volumes / shadow).numpy(), voxels.ends, *camera.shape)
    return csc_array((paths, rows, begins), shape=(camera.shape[0] * camera.shape[1], len(voxels.ends))).tocsr()


@numba.njit(cache=True, nogil=True)
def _gathered(pixels, mm, ends, height, width):  # type: ignore[no-untyped-def]
    """Pixels and paths of each region in turn, and where each begins, from voxels (n,) region by region."""
    rows, paths = np.empty(4 * len(mm), np.int32), np.empty(4 * len(mm))
    begins = np.zeros(len(ends) + 1, np.int32)
    sums, place = np.zeros(height * width), np.full(height * width, -1)
    first, n = 0, 0
    for region in range(len(ends)):
        begin = n
        for voxel in range(first, ends[region]):
            x, y = pixels[voxel]
            left, top = math.floor(x), math.floor(y)
            for corner in range(4):
                column, row = left + (corner & 1), top + (corner >> 1)
                if 0 <= column < width and 0 <= row < height:
                    pixel = row * width + column
                    if place[pixel] < begin:  # not met in this region yet
                        place[pixel] = n
                        rows[n] = pixel
                        n += 1
                    sums[pixel] += mm[voxel] * (1 - abs(x - column)) * (1 - abs(y - row))
        for entry in range(begin, n):
            paths[entry] = sums[rows[entry]]
            sums[rows[entry]] = 0.0
        begins[region + 1] = n
        first = ends[region]
    return rows[:n], paths[:n], begins


def materials(attenuation: Doubles, weights: Indices) -> tuple[Indices, Doubles]:
    """Few materials that blocks are of: the number of each block's, and what they attenuate.

    The fewest, at most four, within which the logarithm of the attenuation, weighted, spreads by no more than 0.4 (one)
    or 0.2 (several): k-means on a line (Lloyd, IEEE Trans Inf Theory 28 (1982) 129), from quantiles.
    """
    logarithm = np.log(np.maximum(attenuation, _LEAST_ATTENUATION))
    order = np.argsort(logarithm)
    reached = np.cumsum(weights[order]) / weights.sum()
    for count in range(1, _MOST_MATERIALS + 1):
        middles = logarithm[order][np.searchsorted(reached, (np.arange(count) + 0.5) / count)]
        for _ in range(50):
            nearest = np.abs(logarithm[:, None] - middles).argmin(1)
            total = np.bincount(nearest, weights, count)
            sums = np.bincount(nearest, weights * logarithm, count)
            middles = np.where(total > 0, sums / np.maximum(total, 1), middles)
        spread = np.sqrt(np.average((logarithm - middles[nearest]) ** 2, weights=weights))
        if spread <= (_SPREAD_OF_ONE if count == 1 else _SPREAD_OF_SEVERAL):
            break
    return nearest, np.exp(middles)
