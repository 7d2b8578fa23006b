"""Exposed parts of a detector that a case tells, in pixels of the image: centre of the first pixel at (0, 0)."""

from dataclasses import dataclass

import torch
from torch import Tensor

_SIDE_BY_SIDE = 8  # lines; fewer may be dead ones of the detector


@dataclass(frozen=True)
class Circle:
    """A round field."""

    centre: tuple[float, float]  # column, row
    radius: float

    def exposed(self, shape: tuple[int, int]) -> Tensor:
        """The pixels (H, W), bool, that lie in it."""
        columns, rows = _pixels(shape)
        return torch.hypot(columns - self.centre[0], rows - self.centre[1]) <= self.radius


@dataclass(frozen=True)
class Polygon:
    """A field with straight edges."""

    corners: tuple[tuple[float, float], ...]  # column, row; in order

    def exposed(self, shape: tuple[int, int]) -> Tensor:
        """The pixels (H, W), bool, that lie in it: rays to their right cross its edge an odd number of times."""
        columns, rows = _pixels(shape)
        inside = torch.zeros(shape, dtype=torch.bool)
        for (x0, y0), (x1, y1) in zip(self.corners, (*self.corners[1:], self.corners[0]), strict=True):
            if y0 != y1:
                crossing = x0 + (rows - y0) * (x1 - x0) / (y1 - y0)
                inside ^= ((y0 > rows) != (y1 > rows)) & (columns < crossing)
        return inside


@dataclass(frozen=True)
class Overlap:
    """What several shutters leave that lie over one another."""

    shapes: tuple[Circle | Polygon, ...]

    def exposed(self, shape: tuple[int, int]) -> Tensor:
        """The pixels (H, W), bool, that lie in all of them."""
        inside = torch.ones(shape, dtype=torch.bool)
        for one in self.shapes:
            inside &= one.exposed(shape)
        return inside


def _pixels(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Columns (1, W) and rows (H, 1)."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in shape)
    return columns[None], rows[:, None]


def blank_lines(light: Tensor) -> Tensor | None:
    """The pixels (H, W), bool, of whole rows and columns that hold nothing but an image's least intensity.

    As a file that was cut short leaves them, or a picture set into a larger one: noise leaves no such line. None where
    there are fewer than eight of them side by side, or nothing else.
    """
    darkest = light == light.min()
    rows, columns = (_runs(darkest.all(dim)) for dim in (1, 0))
    blank = rows[:, None] | columns
    return blank if blank.any() and not blank.all() else None


def _runs(lines: Tensor) -> Tensor:
    """Those of lines (N,), bool, that stand with seven others or more side by side."""
    if not lines.any():
        return lines
    _, part, length = torch.unique_consecutive(lines, return_inverse=True, return_counts=True)
    return lines & (length[part] >= _SIDE_BY_SIDE)
