"""Optimisers behind one interface: an objective over deltas in units of their scales goes in, a `Result` comes out."""

from femoreg_torch.optimize.bobyqa import Bobyqa, minimise_bobyqa
from femoreg_torch.optimize.cmaes import CmaEs, minimise_cmaes
from femoreg_torch.optimize.levenberg import LevenbergMarquardt, minimise_levenberg_marquardt
from femoreg_torch.optimize.quadratic import Quadratic, SmoothObjective
from femoreg_torch.optimize.result import Objective, Result, Stop

Settings = CmaEs | Bobyqa | LevenbergMarquardt


def minimise(objective: Objective | SmoothObjective, n: int, settings: Settings, seed: int) -> Result:
    """Minimise an objective over deltas (n,) from zero with the optimiser that `settings` belong to.

    Raises `TypeError` where Levenberg–Marquardt is given an objective without derivatives.
    """
    if isinstance(settings, CmaEs):
        return minimise_cmaes(objective, n, settings, seed)
    if isinstance(settings, Bobyqa):
        return minimise_bobyqa(objective, n, settings)
    if not isinstance(objective, SmoothObjective):
        raise TypeError("Levenberg–Marquardt needs a SmoothObjective")
    return minimise_levenberg_marquardt(objective, n, settings, seed)


__all__ = [
    "Bobyqa",
    "CmaEs",
    "LevenbergMarquardt",
    "Objective",
    "Quadratic",
    "Result",
    "Settings",
    "SmoothObjective",
    "Stop",
    "minimise",
]
