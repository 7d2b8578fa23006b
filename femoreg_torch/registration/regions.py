"""Regions of a device: blocks of a solid, the paths of rays through them, and the few materials that they are of."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.volume import Volume

_BLOCK_MM = 6.0  # longest edge of a block of a solid whose parts nobody names
# Standard deviation of the logarithm of attenuation within one material, blocks being fitted so well. A solid of one
# material is common, and a second one would be the fit's noise; where there are several anyhow, they are told apart.
_SPREAD_OF_ONE, _SPREAD_OF_SEVERAL = 0.4, 0.2
_MOST_MATERIALS = 4
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
    found = []
    for axis in range(3):
        size = owner.shape[axis]
        a, b = owner.narrow(axis, 0, size - 1), owner.narrow(axis, 1, size - 1)
        touching = (a != b) & (a >= 0) & (b >= 0)
        found.append(torch.stack([a[touching], b[touching]], 1))
    pairs, faces = np.unique(torch.cat(found).sort(1).values.numpy(), axis=0, return_counts=True)
    return np.column_stack([pairs, faces])


def region_paths(share: Volume, owner: Tensor, count: int, camera_from_volume: Tensor, camera: Camera) -> csr_array:
    """Paths in mm (H · W, K) of the rays through K regions of a volume that holds the share of every voxel in it.

    Every voxel adds its volume, per area of a pixel's shadow at its depth, to the four pixels around where it is seen.
    """
    where = share.data.nonzero()
    points = transform_points(camera_from_volume @ share.lps_from_index, where.flip(1).double())
    pixels = project_points(camera, points)  # (n, 2) column, row
    first = pixels.floor()
    inside = pixels - first
    slant = points[:, 2] / points.norm(dim=1)
    shadow = (points[:, 2] / camera.sdd_mm) ** 2 * camera.pixel_mm[0] * camera.pixel_mm[1] * slant
    mm = share.data[where.unbind(1)].double() * math.prod(share.spacing_mm) / shadow
    region = owner[where.unbind(1)]
    rows, columns, values = [], [], []
    for right in (0, 1):
        for below in (0, 1):
            column, row = first[:, 0] + right, first[:, 1] + below
            weight = (inside[:, 0] - (1 - right)).abs() * (inside[:, 1] - (1 - below)).abs()
            seen = (column >= 0) & (row >= 0) & (column < camera.shape[1]) & (row < camera.shape[0])
            rows.append((row * camera.shape[1] + column)[seen].long())
            columns.append(region[seen])
            values.append((mm * weight)[seen])
    triples = (torch.cat(values).numpy(), (torch.cat(rows).numpy(), torch.cat(columns).numpy()))
    return csr_array(triples, shape=(camera.shape[0] * camera.shape[1], count))


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
