"""An objective that also knows its slope and its curvature, for methods of second order."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
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


@dataclass(frozen=True, eq=False)
class Profile:
    """What a quadratic says of its last m unknowns with the n others refitted to them."""

    answer: Tensor  # (n, m): how the others move with them, J = −Hxx⁻¹ Hxq
    curvature: Tensor  # (m, m): S = Hqq + Hqx J
    scores: Tensor  # (T, m): of parts of the data, r = s_q + Jᵀ s_x


def profile(model: Quadratic, last: int) -> Profile:
    """The profile of a quadratic in its `last` unknowns, so many."""
    n = len(model.hessian) - last
    hessian = model.hessian
    answer = -torch.linalg.pinv(hessian[:n, :n], hermitian=True) @ hessian[:n, n:]
    scores = model.scores[:, n:] + model.scores[:, :n] @ answer
    return Profile(answer, hessian[n:, n:] + hessian[n:, :n] @ answer, scores)
