"""An objective that also knows its slope and its curvature, for methods of second order."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Quadratic:
    """An objective about one point: value + gradient · d + ½ d · hessian · d, with a hessian without negative parts."""

    value: float
    scores: Tensor  # (T, n): the part of the gradient that each of T parts of the data has
    hessian: Tensor  # (n, n)

    @property
    def gradient(self) -> Tensor:
        """First derivatives (n,)."""
        return self.scores.sum(0)


@dataclass(frozen=True)
class SmoothObjective:
    """Values (P,) of deltas (P, n), lower is better; and the quadratic about one delta (n,)."""

    values: Callable[[Tensor], Tensor]
    quadratic: Callable[[Tensor], Quadratic]

    def __call__(self, deltas: Tensor) -> Tensor:
        return self.values(deltas)
