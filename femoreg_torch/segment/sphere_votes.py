"""Spheres of bone in a CT: sheets of cortex vote for the centres that they stand square to; rays from a point."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.segment.sheets import Values

Points = NDArray[np.float64]

COARSE_MM = 2.0  # voxels on which spheres are looked for
RIDGE_RANGE_HU = (-100.0, 800.0)  # beyond is air, or metal
# Of heads (20 to 28 in adults) and of the sockets around them. What fits best at the first or the last is no head: it
# may fit better still beyond them, as a shaft's end (18) and a condyle of a knee (31) do.
RADII_MM = np.arange(18.0, 32.0)
_RIDGE_MM = 1.5  # standard deviation of the blur before the Hessian
_RIDGE_HU = 100.0
_RIDGE_SHARE, _RIDGE_FLAT = 0.4, 0.5  # the strongest so many; |λ₂| at most so much of |λ₃|


def sphere_votes(hu: Values) -> tuple[Values, Values]:
    """For each voxel (Z, Y, X) of 2 mm how many sheets of bone face it at one distance, and that distance, mm.

    A Hough transform: the ridges of cortex, also of a socket's, vote along their normals, both ways. `hu` lies within
    `RIDGE_RANGE_HU`.
    """
    sigma = _RIDGE_MM / COARSE_MM
    bone = hu > _RIDGE_HU
    best, at = np.zeros(hu.shape, np.float32), np.zeros(hu.shape, np.float32)
    if not bone.any():
        return best, at
    second = ((2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2))
    zz, zy, zx, yy, yx, xx = (ndimage.gaussian_filter(hu, sigma, order)[bone] for order in second)
    values, vectors = np.linalg.eigh(np.stack([zz, zy, zx, zy, yy, yx, zx, yx, xx], -1).reshape(-1, 3, 3))
    across, along = -values[:, 0], np.abs(values[:, 1:]).max(1)
    ridge = (across > 0) & (along < _RIDGE_FLAT * across)
    ridge &= across >= np.quantile(across, 1 - _RIDGE_SHARE)
    places, normals = np.argwhere(bone)[ridge], vectors[ridge, :, 0]
    for radius in RADII_MM:
        votes = np.zeros(hu.size, np.float32)
        for way in (radius, -radius):
            to = np.round(places + normals * way / COARSE_MM).astype(int)
            to = to[((to >= 0) & (to < hu.shape)).all(1)]
            votes += np.bincount(np.ravel_multi_index(tuple(to.T), hu.shape), minlength=hu.size)
        smooth = ndimage.gaussian_filter(votes.reshape(hu.shape), 1.5) / radius**1.5
        at[smooth > best] = radius
        best = np.maximum(best, smooth)
    return best, at


def directions(count: int = 300) -> Points:
    """Unit vectors (count, 3), evenly spread; the first is next to the first axis."""
    n = np.arange(count) + 0.5
    up, turn = 1 - 2 * n / count, np.pi * (1 + np.sqrt(5)) * n
    level = np.sqrt(1 - up**2)
    return np.stack([up, level * np.sin(turn), level * np.cos(turn)], 1)


def along_rays(values: Values, place: Points, ways: Points, radii: Points) -> Values:
    """Values (ways, radii) along rays from a place (3,), all in voxels; beyond the volume 0."""
    points = place[:, None, None] + ways.T[:, :, None] * radii
    result: Values = ndimage.map_coordinates(values, points, order=1, mode="constant")
    return result
