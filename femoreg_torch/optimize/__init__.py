"""Optimisers behind one interface: an objective over deltas in units of their scales goes in, a `Result` comes out."""

from femoreg_torch.optimize.bobyqa import Bobyqa, minimise_bobyqa
from femoreg_torch.optimize.cmaes import CmaEs, minimise_cmaes
from femoreg_torch.optimize.result import Objective, Result, Stop

Settings = CmaEs | Bobyqa


def minimise(objective: Objective, n: int, settings: Settings, seed: int) -> Result:
    """Minimise an objective over deltas (n,) from zero with the optimiser that `settings` belong to."""
    if isinstance(settings, CmaEs):
        return minimise_cmaes(objective, n, settings, seed)
    return minimise_bobyqa(objective, n, settings)


__all__ = ["Bobyqa", "CmaEs", "Objective", "Result", "Settings", "Stop", "minimise"]
