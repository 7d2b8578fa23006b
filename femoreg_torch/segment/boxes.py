"""Boxes around each voxel, their sizes in mm."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]


def radius(mm: float, spacing: NDArray[np.float64]) -> tuple[int, int, int]:
    """Voxels along z, y, x in so many mm, at least one; `spacing` (3,) mm along x, y, z."""
    x, y, z = (max(1, round(mm / float(s))) for s in spacing)
    return z, y, x


def width(mm: float, spacing: NDArray[np.float64]) -> list[int]:
    """Voxels along z, y, x of a box that reaches so many mm to either side of its middle voxel."""
    return [2 * r + 1 for r in radius(mm, spacing)]


def mean_near(values: NDArray[np.float32], there: Mask, size: list[int]) -> NDArray[np.float32]:
    """Mean in a box around each voxel (Z, Y, X) of the values that are there; NaN without any."""
    share = ndimage.uniform_filter(there.astype(np.float32), size, mode="constant")
    total = ndimage.uniform_filter(values * there, size, mode="constant")
    return np.where(share > 0.5 / np.prod(size), total, np.nan) / np.maximum(share, 1e-9)
