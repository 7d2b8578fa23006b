"""The sphere of a femoral head."""

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

_INLIER_MM = 1.0
_REFITS = 30


def fitted_sphere(points: Points) -> Points:
    """Algebraic least-squares sphere through points (N, 3): centre and radius (4,)."""
    equations = np.c_[2 * points, np.ones(len(points))]
    solution = np.linalg.lstsq(equations, (points**2).sum(1), rcond=None)[0]
    return np.r_[solution[:3], np.sqrt(solution[3] + (solution[:3] ** 2).sum())]


def refitted_sphere(points: Points, first: NDArray[np.bool_]) -> Points:
    """Centre and radius (4,): fitted to the `first` of the points (N, 3), then again to those within 1 mm of it."""
    sphere = fitted_sphere(points[first])
    for _ in range(_REFITS):
        off = np.abs(np.linalg.norm(points - sphere[:3], axis=1) - sphere[3])
        sphere = fitted_sphere(points[off < _INLIER_MM])
    return sphere
