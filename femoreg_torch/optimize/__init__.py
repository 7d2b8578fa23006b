"""Optimisers: settings that minimise an objective over deltas in units of their scales, and return a `Result`."""

from femoreg_torch.optimize.bobyqa import Bobyqa
from femoreg_torch.optimize.cmaes import CmaEs
from femoreg_torch.optimize.kinds import read_optimiser
from femoreg_torch.optimize.levenberg import LevenbergMarquardt
from femoreg_torch.optimize.parabola import parabola_minimum
from femoreg_torch.optimize.quadratic import Profile, Quadratic, SmoothObjective, profile
from femoreg_torch.optimize.result import BestSoFar, Objective, Optimiser, Result, Stop

__all__ = [
    "BestSoFar",
    "Bobyqa",
    "CmaEs",
    "LevenbergMarquardt",
    "Objective",
    "Optimiser",
    "Profile",
    "Quadratic",
    "Result",
    "SmoothObjective",
    "Stop",
    "parabola_minimum",
    "profile",
    "read_optimiser",
]
