"""CMA-ES: global enough to find the basin, batched over its population."""

import math
import warnings
from dataclasses import dataclass

import numpy as np
import torch

from femoreg_torch.optimize.result import BestSoFar, Objective, Result, Stop
from femoreg_torch.settings import check_within


@dataclass(frozen=True)
class CmaEs:
    """Settings of CMA-ES (Hansen, The CMA evolution strategy: a tutorial, arXiv 1604.00772).

    Deltas are measured in the initial standard deviation of each degree of freedom, so the search starts with 1 in all.
    """

    population: int = 50
    max_evaluations: int = 2000
    tol_x: float = 1e-3  # in initial standard deviations
    tol_f: float = 1e-5

    def __post_init__(self) -> None:
        check_within(self, population=(2, 100_000), max_evaluations=(1, 10**7), tol_x=(0, 1), tol_f=(0, 1e6))

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        """Minimise over deltas (n,), starting from zero; returns the best point ever met.

        The final mean of the distribution is evaluated too: on a noisy objective it is often the better point.
        """
        with warnings.catch_warnings():  # cma warns where matplotlib is missing, which only its plots need
            warnings.simplefilter("ignore", UserWarning)
            import cma  # takes most of a second, and few presets use it
        track = BestSoFar(objective)
        generator = np.random.default_rng(seed % 2**64)
        options = {
            "popsize": self.population,
            "tolx": self.tol_x,
            "tolfun": self.tol_f,
            "tolfunhist": self.tol_f / 10,
            "maxfevals": self.max_evaluations,
            # NumPy's own generator, which `cma` seeds and draws from by default, is one for all threads.
            "seed": math.nan,
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -9,
        }
        strategy = cma.CMAEvolutionStrategy(np.zeros(n), 1.0, options)
        track(torch.zeros(1, n, dtype=torch.float64))
        while not (reasons := strategy.stop()):
            asked = strategy.ask()
            values = track(torch.from_numpy(np.stack(asked)))
            strategy.tell(asked, values.tolist())
        track(torch.from_numpy(strategy.mean)[None])
        if "maxfevals" in reasons:
            return track.result(Stop.BUDGET)
        return track.result(Stop.SMALL_STEP if "tolx" in reasons else Stop.FLAT)
