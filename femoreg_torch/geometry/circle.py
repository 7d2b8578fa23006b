"""Circles through points of a plane."""

import numpy as np
from numpy.typing import NDArray


def circle_through(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Middle (2,) and radius of the circle through points (N, 2) by algebraic least squares (Kåsa 1976).

    Points lie about their mean while it is fitted, so that no digits are lost far from the origin.
    """
    origin = points.mean(0)
    moved = points - origin
    unknowns = np.linalg.lstsq(np.c_[2 * moved, np.ones(len(points))], (moved**2).sum(1), rcond=None)[0]
    middle = unknowns[:2]
    return middle + origin, float(np.sqrt(max(unknowns[2] + middle @ middle, 0.0)))
