"""Closed surfaces to voxels, and arrays at other voxel sizes. All arrays are [x, y, z]."""

from collections.abc import Sequence

import numba as nb
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float32]
Points = NDArray[np.float64]

_TOLERANCE = 2.0**-17  # voxels; a centre so near to the surface counts as inside


def inside_surface(mesh: trimesh.Trimesh, first: Points, shape: tuple[int, ...], spacing_mm: float) -> NDArray[np.int8]:
    """1 for voxels of this shape whose centre first + spacing * index, mm, lies inside a closed surface, else 0."""
    # the tiny shift keeps vertices and edges off the rows of voxels, where they would count twice
    triangles = (mesh.triangles - first) / spacing_mm + np.array([0.0, 1.37e-9, 2.11e-9])
    crossings = np.zeros((shape[0] + 1, *shape[1:]), np.int8)
    _count_crossings(np.ascontiguousarray(triangles), crossings, _TOLERANCE)
    within: NDArray[np.int8] = (np.cumsum(crossings, axis=0, dtype=np.int8)[:-1] > 0).astype(np.int8)
    return within


@nb.njit(cache=True)
def _count_crossings(triangles, crossings, tolerance):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Add 1 where a row along x enters the solid and −1 where it leaves; `triangles` (F, 3, 3) in index units."""
    size, rows, layers = crossings.shape
    for f in range(triangles.shape[0]):
        ax, ay, az = triangles[f, 0]
        bx, by, bz = triangles[f, 1]
        cx, cy, cz = triangles[f, 2]
        area = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
        if area == 0:
            continue
        first_row, last_row = max(0, int(np.ceil(min(ay, by, cy)))), min(rows - 1, int(np.floor(max(ay, by, cy))))
        first_layer, last_layer = max(0, int(np.ceil(min(az, bz, cz)))), min(layers - 1, int(np.floor(max(az, bz, cz))))
        for j in range(first_row, last_row + 1):
            for k in range(first_layer, last_layer + 1):
                u = ((by - j) * (cz - k) - (bz - k) * (cy - j)) / area
                v = ((cy - j) * (az - k) - (cz - k) * (ay - j)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                x = u * ax + v * bx + w * cx
                entering = area < 0  # the normal points against x
                i = int(np.ceil(x - tolerance)) if entering else int(np.floor(x + tolerance)) + 1
                if i < size:
                    crossings[max(i, 0), j, k] += 1 if entering else -1


def block_mean(values: NDArray[np.generic], factor: int = 2) -> Array:
    """Averages of a volume (X, Y, Z) over blocks of `factor` voxels along each axis, float32."""
    x, y, z = (n // factor for n in values.shape)
    mean: Array = values.reshape(x, factor, y, factor, z, factor).mean((1, 3, 5), dtype=np.float32)
    return mean


def halved_voxels(values: Array) -> Array:
    """Voxels of half the size by linear interpolation; the outer edges of the volume stay where they are."""
    for axis in range(3):
        edge = np.take(values, [0, -1], axis)
        padded = np.concatenate([np.take(edge, [0], axis), values, np.take(edge, [1], axis)], axis)
        here, before, after = (_part(padded, axis, start, values.shape[axis]) for start in (1, 0, 2))
        pairs = np.stack([0.75 * here + 0.25 * before, 0.75 * here + 0.25 * after], axis + 1)
        values = pairs.reshape([2 * n if a == axis else n for a, n in enumerate(values.shape)])
    return values


def _part(values: Array, axis: int, start: int, count: int) -> Array:
    return values[(slice(None),) * axis + (slice(start, start + count),)]


def smooth_noise(shape: Sequence[int], sigma: float, rng: np.random.Generator) -> Array:
    """Gaussian random field of mean 0 and standard deviation 1; `sigma` in voxels. Drawn coarsely where it is large."""
    step = max(1, int(sigma // 2))
    coarse = [int(np.ceil(n / step)) + 2 for n in shape]
    noise = ndimage.gaussian_filter(rng.standard_normal(coarse, dtype=np.float32), sigma / step)
    if step > 1:
        noise = ndimage.zoom(noise, step, order=1)
    noise = noise[tuple(slice(n) for n in shape)]
    field: Array = (noise - noise.mean()) / noise.std()
    return field


def along_axes(first: Points, counts: Sequence[int], spacing_mm: float) -> list[Points]:
    """Voxel centres along x, y and z, mm, each shaped to broadcast to [x, y, z]; `first` (3,) is the corner."""
    return [
        (first[k] + spacing_mm * (np.arange(counts[k]) + 0.5)).reshape([-1 if i == k else 1 for i in range(3)])
        for k in range(3)
    ]
