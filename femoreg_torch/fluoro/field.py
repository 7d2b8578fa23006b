"""Exposed parts of a detector that a case tells, in pixels of the image: centre of the first pixel at (0, 0)."""

from dataclasses import dataclass

import torch
from torch import Tensor


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


def _pixels(shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Columns (1, W) and rows (H, 1)."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in shape)
    return columns[None], rows[:, None]
