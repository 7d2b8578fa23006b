"""Bones as unions of balls: a skeleton of sheets and tubes with a thickness, turned into a distance field on a grid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import PchipInterpolator, RectBivariateSpline
from scipy.spatial import cKDTree

Array = NDArray[np.float32]
Points = NDArray[np.float64]
SAMPLE_MM = 1.5  # distance of neighbouring balls; a ball of 2 mm radius then leaves dents of 0.14 mm
COARSE = 4  # every fourth node is evaluated everywhere, the rest only near the surface


@nb.njit(cache=True)
def _between(values: Array, below: NDArray[np.int64], share: Array) -> Array:  # pragma: no cover (compiled)
    """Values (A, N, B) between entries `below` (M,) of the middle axis and the next ones; (A, M, B)."""
    out = np.empty((values.shape[0], len(below), values.shape[2]), np.float32)
    for a in range(values.shape[0]):
        for m in range(len(below)):
            k = below[m]
            for b in range(values.shape[2]):
                first = values[a, k, b]
                out[a, m, b] = first + share[m] * (values[a, k + 1, b] - first)
    return out


@dataclass(frozen=True, eq=False)
class Field:
    """Numbers on a grid, for bones the signed distance in mm, negative inside.

    Node (i, j, k) of `values` (X, Y, Z) lies at lo + step * (i, j, k) mm.
    """

    values: Array
    lo: Points
    step: float

    def axes(self) -> tuple[Array, Array, Array]:
        """Node positions along x, y, z, mm, broadcastable against `values`."""
        x, y, z = (
            (self.lo[a] + self.step * np.arange(n)).astype(np.float32).reshape([-1 if a == b else 1 for b in range(3)])
            for a, n in enumerate(self.values.shape)
        )
        return x, y, z

    def within(self, x: Points, y: Points, z: Points) -> tuple[slice, slice, slice]:
        """Which part of the grid spanned by three rising lists of mm lies inside this field."""
        ends = zip((x, y, z), self.lo, self.lo + self.step * (np.array(self.values.shape) - 1), strict=True)
        i, j, k = (slice(*np.searchsorted(axis, [first, last])) for axis, first, last in ends)
        return i, j, k

    def carved(self, hole: Array) -> "Field":
        """The shape without `hole`, a signed distance (negative inside) that broadcasts against this field."""
        return Field(np.maximum(self.values, -hole), self.lo, self.step)

    def smoothed(self, sigma_mm: float) -> "Field":
        """Creases filled and edges rounded; flat faces stay where they are."""
        return Field(ndimage.gaussian_filter(self.values, sigma_mm / self.step), self.lo, self.step)

    def at(self, points: Points) -> Points:
        """Trilinear distance at points (N, 3) mm; outside the grid the value of its edge."""
        index = ((points - self.lo) / self.step).T
        values: Points = ndimage.map_coordinates(self.values, index, order=1, mode="nearest")
        return values

    def on_axes(self, x: Points, y: Points, z: Points) -> Array:
        """Trilinear values (X, Y, Z) on the grid of three rising lists of mm; beyond this field those of its edge."""
        values = np.ascontiguousarray(self.values)
        for axis, position in enumerate((x, y, z)):
            index = np.clip((position - self.lo[axis]) / self.step, 0, values.shape[axis] - 1)
            below = np.minimum(index.astype(int), values.shape[axis] - 2)
            share = (index - below).astype(np.float32)
            before, after = math.prod(values.shape[:axis]), math.prod(values.shape[axis + 1 :])
            shape = (*values.shape[:axis], len(position), *values.shape[axis + 1 :])
            values = _between(values.reshape(before, -1, after), below, share).reshape(shape)
        return values

    def surface(self) -> Points:
        """Points (N, 3) mm of the zero level, one per node near it, moved there along the gradient."""
        inner = np.abs(self.values) < 0.75 * self.step
        nodes = np.argwhere(inner)
        nodes = nodes[np.all((nodes > 0) & (nodes < np.array(self.values.shape) - 1), axis=1)]
        points = nodes * self.step + self.lo
        for _ in range(3):
            shift = 0.5 * self.step * np.eye(3)
            slope = np.stack([self.at(points + s) - self.at(points - s) for s in shift], 1) / self.step
            norm2 = np.maximum((slope**2).sum(1), 0.1)
            points = points - (self.at(points) / norm2)[:, None] * slope
        return points[np.abs(self.at(points)) < 0.1]


def tube(controls: Sequence[Sequence[float]]) -> Points:
    """Balls (N, 4), x, y, z, radius in mm, along a smooth curve through `controls` (rows of the same four numbers)."""
    knots = np.asarray(controls, float)
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1))]
    at = np.linspace(0, length[-1], max(2, int(np.ceil(length[-1] / SAMPLE_MM)) + 1))
    balls: Points = PchipInterpolator(length, knots)(at)
    return balls


def sheet(controls: Sequence[Sequence[Sequence[float]]]) -> Points:
    """Balls (N, 4), x, y, z, radius in mm, on a smooth sheet through a grid of control balls (rows of columns)."""
    knots = np.asarray(controls, float)
    rows, columns = knots.shape[:2]
    counts = []
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(knots[..., :3], axis=axis), axis=-1).sum(axis).max()
        counts.append(max(2, int(np.ceil(length / SAMPLE_MM)) + 1))
    u, v = np.linspace(0, rows - 1, counts[0]), np.linspace(0, columns - 1, counts[1])
    order = (min(3, rows - 1), min(3, columns - 1))
    channels = [
        RectBivariateSpline(np.arange(rows), np.arange(columns), knots[..., c], kx=order[0], ky=order[1])(u, v)
        for c in range(4)
    ]
    balls = np.stack(channels, -1).reshape(-1, 4)
    balls[:, 3] = np.clip(balls[:, 3], knots[..., 3].min(), knots[..., 3].max())  # cubic splines overshoot
    return balls


def ball_union(balls: Points, step: float, margin_mm: float = 6.0) -> Field:
    """Signed distance to the union of balls (N, 4), on a grid that reaches `margin_mm` beyond them.

    The ball that decides at x is the one of least power |x - p|² - r² (the surface of a union of balls is the zero set
    of that minimum: Edelsbrunner, "The union of balls and its dual shape", Discrete Comput. Geom. 13, 1995). With
    sqrt(r_max² - r²) as a fourth coordinate it is a nearest neighbour.
    """
    centres, radii = balls[:, :3], balls[:, 3]
    lo = (centres - radii[:, None]).min(0) - margin_mm
    hi = (centres + radii[:, None]).max(0) + margin_mm
    cells = np.ceil((hi - lo) / step / COARSE).astype(int)
    tree = cKDTree(np.c_[centres, np.sqrt(radii.max() ** 2 - radii**2)])

    def signed(nodes: NDArray[np.int64], spacing: float) -> Array:
        points = np.c_[nodes * spacing + lo, np.zeros(len(nodes))]
        nearest = tree.query(points, workers=2)[1]
        distance = np.linalg.norm(points[:, :3] - centres[nearest], axis=1) - radii[nearest]
        return distance.astype(np.float32)

    shape = tuple(int(n) + 1 for n in cells)
    coarse = Field(signed(np.indices(shape).reshape(3, -1).T, step * COARSE).reshape(shape), lo, step * COARSE)
    fine_axes = [lo[a] + step * np.arange(COARSE * cells[a] + 1) for a in range(3)]
    distance = coarse.on_axes(*fine_axes)
    near = np.abs(distance) < COARSE * step
    distance[near] = signed(np.argwhere(near), step)
    return Field(distance, lo, step)


def ball(axes: tuple[Array, Array, Array], centre: Points, radius: float) -> Array:
    """Signed distance to one ball on the nodes of a field."""
    x, y, z = axes
    return np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2).astype(np.float32) - radius


def rod(axes: tuple[Array, Array, Array], start: Points, end: Points, radius: float) -> Array:
    """Signed distance to a rod with round ends from `start` to `end` (3,) mm on the nodes of a field."""
    along = end - start
    relative = [a - s for a, s in zip(axes, start, strict=True)]
    share = np.clip(sum(r * d for r, d in zip(relative, along, strict=True)) / (along @ along), 0, 1)
    squares = sum((r - share * d) ** 2 for r, d in zip(relative, along, strict=True))
    return np.sqrt(squares).astype(np.float32) - radius
