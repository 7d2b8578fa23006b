"""What every optimiser takes and returns."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import torch
from torch import Tensor

Objective = Callable[[Tensor], Tensor]  # deltas (P, n) in units of their scale -> values (P,), lower is better


class Stop(Enum):
    """Why an optimiser stopped, each with a sentence for people."""

    SMALL_STEP = "the step became smaller than its tolerance"
    FLAT = "the value no longer improves by more than its tolerance"
    BUDGET = "the evaluations allowed were used up"
    ROUNDOFF = "rounding errors keep it from improving further"


@dataclass(frozen=True)
class Result:
    """Outcome of one optimisation.

    `delta` (n,) is in units of the scales. `trace` holds (evaluations, best value, best delta) at every improvement,
    `ends` (value, delta) where each start ended, if there were several.
    """

    delta: Tensor
    value: float
    stop: Stop
    evaluations: int
    trace: tuple[tuple[int, float, tuple[float, ...]], ...] = ()
    ends: tuple[tuple[float, tuple[float, ...]], ...] = ()


class Optimiser(Protocol):
    """Settings of an optimiser, by convention a frozen dataclass, which presets read by its `kind`."""

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        """Minimise over deltas (n,), starting from zero; the same seed gives the same result.

        The objective of a stage is a `SmoothObjective`, which has derivatives too if the stage's similarity has them.
        """


class BestSoFar:
    """Counts evaluations of an objective and keeps the best point and the trace of improvements."""

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self.evaluations = 0
        self.value = float("inf")
        self.delta: Tensor | None = None
        self.trace: list[tuple[int, float, tuple[float, ...]]] = []

    def __call__(self, deltas: Tensor) -> Tensor:
        """Values (P,) of deltas (P, n)."""
        values = self._objective(deltas)
        best = int(values.nan_to_num(nan=torch.inf, posinf=torch.inf).argmin())
        self.evaluations += len(deltas) - 1
        self.count(deltas[best], float(values[best]))
        return values

    def count(self, delta: Tensor, value: float) -> None:
        """Take one evaluation, made elsewhere, into account."""
        self.evaluations += 1
        if value < self.value:
            self.value, self.delta = value, delta.clone()
            self.trace.append((self.evaluations, value, tuple(delta.tolist())))

    def result(self, stop: Stop) -> Result:
        """The best point met so far. Raises `ArithmeticError` if no value was ever finite."""
        if self.delta is None:
            raise ArithmeticError("the objective was never finite: nothing to optimise")
        return Result(self.delta, self.value, stop, self.evaluations, tuple(self.trace))
