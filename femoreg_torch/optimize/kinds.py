"""Which optimiser a preset means by `kind`."""

from typing import Any

from femoreg_torch.extensions import check_has, read_kind
from femoreg_torch.optimize.bobyqa import Bobyqa
from femoreg_torch.optimize.cmaes import CmaEs
from femoreg_torch.optimize.levenberg import LevenbergMarquardt
from femoreg_torch.optimize.result import Optimiser

OPTIMISERS = {"cma_es": CmaEs, "bobyqa": Bobyqa, "levenberg_marquardt": LevenbergMarquardt}


def read_optimiser(content: Any, where: str) -> Optimiser:
    """An optimiser from a mapping such as `{kind: cma_es, population: 50}`. Raises `InputError`, see `read_kind`."""
    optimiser: Optimiser = read_kind("femoreg_torch.optimisers", OPTIMISERS, content, where)
    check_has(optimiser, "femoreg_torch.optimisers", ["minimise"], where)
    return optimiser
