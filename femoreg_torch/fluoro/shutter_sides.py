"""Sides of a shutter in an image, as circles and straight lines in mm on the detector, and how points tell them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.geometry import circle_through

_TRIES = 150  # random circles or lines
_ROUNDER = 3  # times as many edge points lie on a circle as on a line; on that across the sides of an octagon, 1.3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Grid:
    """Coarse pixels: places (N, 2) along columns and rows, in mm from the middle of the first pixel."""

    shape: tuple[int, ...]
    pixel_mm: tuple[float, float]  # along columns, rows

    @property
    def edge_mm(self) -> float:
        """The longer side of a pixel."""
        return max(self.pixel_mm)

    @property
    def places(self) -> Array:
        rows, columns = np.indices(self.shape)
        return self.at(np.stack([columns, rows], -1).reshape(-1, 2))

    @property
    def middle(self) -> Array:
        """The middle of the detector."""
        return np.asarray((np.array(self.shape[::-1]) - 1) * self.pixel_mm / 2)

    def at(self, pixels: NDArray[np.int64]) -> Array:
        """Places of pixels (N, 2), column and row."""
        return np.asarray(pixels * np.array(self.pixel_mm))

    def within(self, places: Array) -> Mask:
        """Which places lie on the detector."""
        last = np.array(self.shape[::-1]) - 1
        pixels = places / self.pixel_mm
        return np.asarray(((pixels >= 0) & (pixels <= last)).all(-1))

    def values(self, image: Array, places: Array) -> Array:
        """An image at places (..., 2), interpolated; nan off the detector."""
        last = np.array(self.shape[::-1]) - 1
        pixels = (places / self.pixel_mm).clip(0, last)
        low = np.minimum(pixels.astype(np.int64), last - 1)
        (x, y), (right, down) = np.moveaxis(low, -1, 0), np.moveaxis(pixels - low, -1, 0)
        above = image[y, x] * (1 - right) + image[y, x + 1] * right
        below = image[y + 1, x] * (1 - right) + image[y + 1, x + 1] * right
        return np.where(self.within(places), above * (1 - down) + below * down, np.nan)


@dataclass(frozen=True)
class Ring:
    """A round edge; the field lies within it. Places are (…, 2), mm."""

    middle: Array  # (2,), mm
    radius: float  # mm

    def depth(self, places: Array) -> Array:
        """How far inside places (..., 2) lie, mm."""
        return np.asarray(self.radius - np.linalg.norm(places - self.middle, axis=-1))

    def outwards(self, places: Array) -> Array:
        """Unit vectors (…, 2) out of the field, at places."""
        apart = places - self.middle
        return np.asarray(apart / np.linalg.norm(apart, axis=-1, keepdims=True).clip(1e-9))

    def edge(self, step_mm: float, grid: Grid) -> Array:
        """Places along it."""
        angles = np.linspace(0, 2 * np.pi, max(8, round(2 * np.pi * self.radius / step_mm)), endpoint=False)
        return np.asarray(self.middle + self.radius * np.stack([np.cos(angles), np.sin(angles)], -1))

    def refitted(self, places: Array) -> "Ring":
        """The circle through places (N, 2), by least squares."""
        return _circle_of(places)


@dataclass(frozen=True)
class Line:
    """A straight edge. Places are (…, 2), mm."""

    normal: Array  # (2,) unit vector, outwards
    offset: float  # of the line along it, mm

    def depth(self, places: Array) -> Array:
        """How far inside places (…, 2) lie, mm."""
        return np.asarray(self.offset - places @ self.normal)

    def outwards(self, places: Array) -> Array:
        """Unit vectors (…, 2) out of the field, at places."""
        return np.broadcast_to(self.normal, places.shape)

    def edge(self, step_mm: float, grid: Grid) -> Array:
        """Places (N, 2) along it, across the detector."""
        along = np.array([-self.normal[1], self.normal[0]])
        middle = grid.middle
        reach = float(np.linalg.norm(middle))
        foot = middle + self.depth(middle) * self.normal
        return np.asarray(foot + np.arange(-reach, reach, step_mm)[:, None] * along)

    def refitted(self, places: Array) -> "Line":
        """The line through places (N, 2), by least squares, with the field on the same side."""
        line = _line_of(places)
        return line if line.normal @ self.normal > 0 else Line(-line.normal, -line.offset)


def best_side(
    points: Array, middle: Array, tolerance: float, generator: np.random.Generator, straight: bool
) -> tuple[Ring | Line | None, Mask]:
    """The circle or line, or line alone, that most of the points (N, 2) lie on, and which; `middle` lies inside."""
    size = float(np.ptp(points, axis=0).max())
    best: Ring | Line | None = None
    most = np.zeros(len(points), bool)
    for count in (2,) if straight else (2, 3):
        chosen = points[generator.integers(len(points), size=(_TRIES, count))]
        apart = _from_lines(chosen, points) if count == 2 else _from_circles(chosen, points, size)
        near = apart <= tolerance  # nan, where points coincide, is not near
        fullest = int(near.sum(1).argmax())
        if near[fullest].sum() > most.sum() * (1 if count == 2 else _ROUNDER):
            best, most = (_line_of if count == 2 else _circle_of)(chosen[fullest]), near[fullest]
    if best is not None:
        if isinstance(best, Line) and best.depth(middle) < 0:
            best = Line(-best.normal, -best.offset)
        best = best.refitted(points[most])
        most = np.abs(best.depth(points)) <= 1.5 * tolerance
    return best, most


def _from_lines(pairs: Array, points: Array) -> Array:
    """Distances (T, N) of points (N, 2) from the lines through pairs (T, 2, 2)."""
    along = pairs[:, 1] - pairs[:, 0]
    with np.errstate(invalid="ignore"):
        normals = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(np.abs(normals @ points.T - (normals * pairs[:, 0]).sum(1, keepdims=True)))


def _from_circles(triples: Array, points: Array, size: float) -> Array:
    """Distances (T, N) of points (N, 2) from the circles through triples (T, 3, 2); nan for radii unlike `size`."""
    (ax, ay), (bx, by) = (triples[:, 1] - triples[:, 0]).T, (triples[:, 2] - triples[:, 0]).T
    a, b = ax**2 + ay**2, bx**2 + by**2
    with np.errstate(divide="ignore", invalid="ignore"):
        to_middle = np.stack([by * a - ay * b, ax * b - bx * a], 1) / (2 * (ax * by - ay * bx))[:, None]
        radii = np.linalg.norm(to_middle, axis=1)
        radii[~((radii > 0.1 * size) & (radii < 2 * size))] = np.nan
        middles = triples[:, 0] + to_middle
        squared = (points**2).sum(1) - 2 * middles @ points.T + (middles**2).sum(1)[:, None]
        return np.asarray(np.abs(np.sqrt(squared.clip(0)) - radii[:, None]))


def _line_of(points: Array) -> Line:
    """The line through points (N, 2), by least squares."""
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle)[2][-1]
    return Line(normal, float(normal @ middle))


def _circle_of(points: Array) -> Ring:
    """The circle through points (N, 2)."""
    return Ring(*circle_through(points))
