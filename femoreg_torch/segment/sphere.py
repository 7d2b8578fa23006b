"""The sphere of a femoral head."""

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

_INLIER_MM = 1.0
_REFITS = 30
_NEAR_MM = 4.0  # of a sphere: points of a head that is a tenth longer than wide lie so near
_LEAST_POINTS, _LEAST_RATIO = 50, 0.5
_TRIES, _MOST_COUNTED = 1_000, 2_000  # spheres through four points, and points that each is asked of
_LEAST_VOLUME_MM3 = 50.0  # of the box of three edges from one of the four: of a flatter one no sphere is told


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


def most_supported_sphere(
    points: Points, first: NDArray[np.bool_], radius_mm: tuple[float, float], known: Points
) -> Points:
    """The sphere (4,) that most points (N, 3) lie on, within 1 mm: `known` (4,), or one through four of the `first`.

    Spheres with another radius than `radius_mm` allows are passed over. RANSAC (Fischler and Bolles 1981), drawn from a
    seed of its own.
    """
    generator = np.random.default_rng(0)
    chosen, counted = points[first], points[:: 1 + len(points) // _MOST_COUNTED]
    fours = chosen[generator.integers(0, len(chosen), (_TRIES, 4))]  # (T, 4, 3)
    edges = fours[:, 1:] - fours[:, :1]
    flat = np.abs(np.linalg.det(edges)) < _LEAST_VOLUME_MM3
    middles = np.linalg.solve(edges[~flat], ((edges[~flat] ** 2).sum(2) / 2)[..., None])[..., 0]
    radii, middles = np.linalg.norm(middles, axis=1), middles + fours[~flat, 0]
    allowed = (radii > radius_mm[0]) & (radii < radius_mm[1])
    middles, radii = middles[allowed], radii[allowed]
    if not len(radii):
        return known
    off = np.abs(np.linalg.norm(counted[None] - middles[:, None], axis=2) - radii[:, None])
    best = int((off < _INLIER_MM).sum(1).argmax())
    found = refitted_sphere(points, np.abs(np.linalg.norm(points - middles[best], axis=1) - radii[best]) < _INLIER_MM)
    return max((known, found), key=lambda sphere: _support(points, sphere) if _within(sphere, radius_mm) else -1)


def _support(points: Points, sphere: Points) -> int:
    """How many points (N, 3) lie on a sphere (4,)."""
    return int((np.abs(np.linalg.norm(points - sphere[:3], axis=1) - sphere[3]) < _INLIER_MM).sum())


def _within(sphere: Points, radius_mm: tuple[float, float]) -> bool:
    return radius_mm[0] < sphere[3] < radius_mm[1]


def stretch_along(points: Points, sphere: Points, axis: Points) -> float:
    """How many times as long as across a spheroid about the `axis` (3,), a unit vector, is that fits the points (N, 3).

    Least squares of |across|² = b·q − (t / stretch)² + c, where q is a point seen from the centre of the `sphere` (4,),
    t its part along the axis and `across` the rest: first for points within 4 mm of the sphere, then again for those
    within 1 mm of the spheroid. nan where they fit none.
    """
    q = points - sphere[:3]
    along = q @ axis
    kept, stretch = np.abs(np.linalg.norm(q, axis=1) - sphere[3]) < _NEAR_MM, np.nan
    for _ in range(_REFITS):
        if kept.sum() < _LEAST_POINTS:
            return np.nan
        equations = np.c_[q, along**2, np.ones(len(q))]
        across = (q**2).sum(1) - along**2
        solution = np.linalg.lstsq(equations[kept], across[kept], rcond=None)[0]
        b, square, c = solution[:3], solution[3], solution[4]
        if -square < _LEAST_RATIO**2:
            return np.nan
        stretch = (-square) ** -0.5
        up = (b @ axis) * stretch**2 / 2
        aside = (b - (b @ axis) * axis) / 2
        wide = np.sqrt(max(c + aside @ aside + (up / stretch) ** 2, 0.0))
        out = q - aside - np.outer(along * (1 - 1 / stretch) + up / stretch, axis)
        kept = np.abs(np.linalg.norm(out, axis=1) - wide) < _INLIER_MM
    return float(stretch)
