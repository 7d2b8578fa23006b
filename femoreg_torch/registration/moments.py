"""The path of an optimisation: poses at some of its improvements, for the trace and its replay."""

from collections.abc import Callable

import torch
from torch import Tensor

from femoreg_torch.case.trace import Moment
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import Result

_MOST = 8  # moments of one optimisation: enough to see it converge, and the result stays a small file


def moments_of(result: Result, place: Callable[[Tensor], Poses]) -> tuple[Moment, ...]:
    """Moments evenly among the improvements of an optimisation, first and last included.

    `place` gives the poses of a delta (n,).
    """
    last = len(result.trace) - 1
    chosen = sorted({round(i * last / (_MOST - 1)) for i in range(_MOST)}) if result.trace else []
    return tuple(
        Moment(evaluations, cost, place(torch.tensor(delta, dtype=torch.float64)))
        for evaluations, cost, delta in (result.trace[i] for i in chosen)
    )
