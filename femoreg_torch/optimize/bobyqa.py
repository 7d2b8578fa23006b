"""BOBYQA: a bounded local search by quadratic models, one evaluation at a time."""

from dataclasses import dataclass
from typing import Any

import nlopt
import numpy as np
import torch

from femoreg_torch.optimize.result import BestSoFar, Objective, Result, Stop
from femoreg_torch.settings import check_within


@dataclass(frozen=True)
class Bobyqa:
    """Settings of BOBYQA (Powell, Cambridge NA report 2009/06), as NLopt runs it.

    Deltas are measured in the half-width of the box of each degree of freedom: the box is [−1, 1]ⁿ.
    """

    max_evaluations: int = 300
    first_step: float = 0.25
    tol_x: float = 1e-4

    def __post_init__(self) -> None:
        check_within(self, max_evaluations=(1, 10**7), first_step=(1e-6, 1), tol_x=(0, 1))

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        """Minimise over deltas (n,) in [−1, 1]ⁿ, starting from zero; returns the best point met. Nothing is random."""
        track = BestSoFar(objective)

        def value(x: np.ndarray[Any, Any], _gradient: object) -> float:
            return float(track(torch.from_numpy(x.copy())[None])[0])

        search = nlopt.opt(nlopt.LN_BOBYQA, n)
        search.set_min_objective(value)
        search.set_lower_bounds(np.full(n, -1.0))
        search.set_upper_bounds(np.full(n, 1.0))
        search.set_initial_step(np.full(n, self.first_step))
        search.set_xtol_abs(self.tol_x)
        search.set_maxeval(self.max_evaluations)
        try:
            search.optimize(np.zeros(n))
        except nlopt.RoundoffLimited:
            return track.result(Stop.ROUNDOFF)
        spent = search.last_optimize_result() == nlopt.MAXEVAL_REACHED
        return track.result(Stop.BUDGET if spent else Stop.SMALL_STEP)
