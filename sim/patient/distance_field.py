"""Bones as unions of balls: a skeleton of sheets and tubes with a thickness, turned into a distance field on a grid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import PchipInterpolator, RectBivariateSpline

from sim.smoothing import gaussian_filter

Array = NDArray[np.float32]
Points = NDArray[np.float64]
SAMPLE_MM = 1.5  # distance of neighbouring balls; a ball of 2 mm radius then leaves dents of 0.14 mm
COARSE = 4  # every fourth node is evaluated everywhere, the rest only near the surface


@nb.njit(cache=True, parallel=True)
def _on_axes(values, i, u, j, v, k, w):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Values (X, Y, Z) between nodes i and i + 1, at the share u of the way, and so on for the other axes."""
    out = np.empty((len(i), len(j), len(k)), np.float32)
    for x in nb.prange(len(i)):
        plane = values[i[x]] + u[x] * (values[i[x] + 1] - values[i[x]])
        for y in range(len(j)):
            line = plane[j[y]] + v[y] * (plane[j[y] + 1] - plane[j[y]])
            for z in range(len(k)):
                out[x, y, z] = line[k[z]] + w[z] * (line[k[z] + 1] - line[k[z]])
    return out


@nb.njit(cache=True, parallel=True)
def _at_voxels(values, i, u, j, v, k, w, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """The same at voxels (N,) of the grid that the axes span."""
    out = np.empty(len(x), np.float32)
    for n in nb.prange(len(x)):
        corner = values[i[x[n]] : i[x[n]] + 2, j[y[n]] : j[y[n]] + 2, k[z[n]] : k[z[n]] + 2]
        a, b, c = u[x[n]], v[y[n]], w[z[n]]
        y00 = corner[0, 0, 0] + a * (corner[1, 0, 0] - corner[0, 0, 0])
        y10 = corner[0, 1, 0] + a * (corner[1, 1, 0] - corner[0, 1, 0])
        y01 = corner[0, 0, 1] + a * (corner[1, 0, 1] - corner[0, 0, 1])
        y11 = corner[0, 1, 1] + a * (corner[1, 1, 1] - corner[0, 1, 1])
        z0, z1 = y00 + b * (y10 - y00), y01 + b * (y11 - y01)
        out[n] = z0 + c * (z1 - z0)
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
        return Field(gaussian_filter(self.values, sigma_mm / self.step), self.lo, self.step)

    def at(self, points: Points) -> Points:
        """Trilinear distance at points (N, 3) mm; outside the grid the value of its edge."""
        index = ((points - self.lo) / self.step).T
        values: Points = ndimage.map_coordinates(self.values, index, order=1, mode="nearest")
        return values

    def on_axes(self, x: Points, y: Points, z: Points) -> Array:
        """Trilinear values (X, Y, Z) on the grid of three rising lists of mm; beyond this field those of its edge."""
        return _on_axes(np.ascontiguousarray(self.values), *self.places(x, y, z))

    def across_slices(self, x: Points, y: Points, z: Points) -> Array:
        """The same as (Z, Y, X)."""
        i, u, j, v, k, w = self.places(x, y, z)
        return _on_axes(np.ascontiguousarray(self.values.T), k, w, j, v, i, u)

    def at_voxels(self, axes: tuple[Points, Points, Points], voxels: Sequence[NDArray[np.intp]]) -> Array:
        """The same at some voxels (N,) of that grid, given by their indices along x, y, z."""
        return _at_voxels(np.ascontiguousarray(self.values), *self.places(*axes), *voxels)

    def places(self, x: Points, y: Points, z: Points) -> list[NDArray[Any]]:
        """Axis by axis, the node below each of rising lists of mm, and the share (float32) of the way to the next."""
        found: list[NDArray[Any]] = []
        for axis, position in enumerate((x, y, z)):
            index = np.clip((position - self.lo[axis]) / self.step, 0, self.values.shape[axis] - 1)
            below = np.minimum(index.astype(int), self.values.shape[axis] - 2)
            found += [below, (index - below).astype(np.float32)]
        return found

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
    of that minimum: Edelsbrunner, "The union of balls and its dual shape", Discrete Comput. Geom. 13, 1995).
    """
    centres, radii = np.ascontiguousarray(balls[:, :3]), np.ascontiguousarray(balls[:, 3])
    lo = (centres - radii[:, None]).min(0) - margin_mm
    hi = (centres + radii[:, None]).max(0) + margin_mm
    cells = np.ceil((hi - lo) / step / COARSE).astype(int)
    coarse = Field(np.empty(cells + 1, np.float32), lo, step * COARSE)
    _signed(centres, radii, lo, coarse.step, np.ones(coarse.values.shape, bool), 2, coarse.values)
    distance = coarse.on_axes(*(lo[a] + step * np.arange(COARSE * cells[a] + 1) for a in range(3)))
    _signed(centres, radii, lo, step, np.abs(distance) < COARSE * step, COARSE, distance)
    return Field(distance, lo, step)


@nb.njit(cache=True, parallel=True)
def _signed(centres, radii, lo, step, wanted, edge, out):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Set `out` to the distance to the ball of least power at the `wanted` nodes of a grid.

    Balls that can decide nowhere in a cube of nodes are left out there: first in cubes of 4 · `edge` nodes, of those
    that stay in cubes of `edge`.
    """
    wide = 4 * edge
    rows, columns = -(-out.shape[1] // wide), -(-out.shape[2] // wide)
    everyone = np.arange(len(radii))
    for cube in nb.prange(-(-out.shape[0] // wide) * rows * columns):
        i0, j0, k0 = cube // columns // rows * wide, cube // columns % rows * wide, cube % columns * wide
        if wanted[i0 : i0 + wide, j0 : j0 + wide, k0 : k0 + wide].any():
            some = _may_decide(centres, radii, everyone, lo, step, i0, j0, k0, wide)
            for part in range(64):
                i, j, k = i0 + part // 16 * edge, j0 + part // 4 % 4 * edge, k0 + part % 4 * edge
                here = wanted[i : i + edge, j : j + edge, k : k + edge]
                if here.any():
                    few = _may_decide(centres, radii, some, lo, step, i, j, k, edge)
                    for a, b, c in np.argwhere(here):
                        x, y, z = lo[0] + step * (i + a), lo[1] + step * (j + b), lo[2] + step * (k + c)
                        least, nearest = np.inf, 0
                        for n in few:
                            power = _power(centres, radii, n, x, y, z)
                            if power < least:
                                least, nearest = power, n
                        out[i + a, j + b, k + c] = math.sqrt(least + radii[nearest] ** 2) - radii[nearest]


@nb.njit(cache=True)
def _power(centres, radii, n, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return (x - centres[n, 0]) ** 2 + (y - centres[n, 1]) ** 2 + (z - centres[n, 2]) ** 2 - radii[n] ** 2


@nb.njit(cache=True)
def _may_decide(centres, radii, among, lo, step, i, j, k, edge):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Those `among` the balls whose power may be least somewhere in a cube of nodes.

    The powers of two balls differ by what is linear in x, with twice the distance of their middles as its slope.
    """
    half = (edge - 1) / 2
    x, y, z = lo[0] + step * (i + half), lo[1] + step * (j + half), lo[2] + step * (k + half)
    powers, best = np.empty(len(among)), 0
    for m in range(len(among)):
        powers[m] = _power(centres, radii, among[m], x, y, z)
        if powers[m] < powers[best]:
            best = m
    reach2 = (2 * math.sqrt(3) * half * step) ** 2 * (1 + 1e-6)
    kept, count = np.empty(len(among), np.int64), 0
    for m in range(len(among)):
        n, first = among[m], among[best]
        apart2 = (
            (centres[n, 0] - centres[first, 0]) ** 2
            + (centres[n, 1] - centres[first, 1]) ** 2
            + (centres[n, 2] - centres[first, 2]) ** 2
        )
        if (powers[m] - powers[best]) ** 2 <= reach2 * apart2 + 1e-6:
            kept[count] = n
            count += 1
    return kept[:count]


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
