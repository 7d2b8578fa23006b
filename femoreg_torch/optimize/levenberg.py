"""Levenberg–Marquardt: steps of second order, damped until they improve; from one start or from the best of many."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from femoreg_torch.optimize.quadratic import Quadratic, SmoothObjective
from femoreg_torch.optimize.result import BestSoFar, Objective, Result, Stop
from femoreg_torch.settings import check_within

_DAMPING = 1e-3  # at the start, relative to the curvature of each degree of freedom
_SOFTEST = 1e-4  # least curvature that counts, relative to the mean
_LEAST_DAMPING = 1e-7
_MOST_DAMPING = 1e4
_LONGEST = 30.0  # units of the scales: where nothing bends the values, a step would lead out of all reach
_SHORTER = 0.5  # times the length of a step that fits worse: the most of the next one
_SOFT = 3  # directions that are looked along for the bottom of a valley; five changed errors by 0.05 mm at most
_FLAT = 1e-9  # second difference of values that is none
# Units of the scales: a descent that comes so near to where an earlier one ended, and lies higher, would end there.
_SAME = 0.25


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Settings of Levenberg–Marquardt with Nielsen's damping.

    K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares problems, DTU 2004, algorithm 3.16.
    After a step that fits worse, the damping rises until the next one is at most half as long: from little damping, one
    step after another would lead to the same place.
    With `candidates`, so many random deltas of deviation one are looked at first, and the best `starts` of them and
    zero are refined; the search ends with the best of these. One that comes where an earlier one ended, and fits no
    better, is given up: it would end there too.

    An objective that is drawn from voxels ripples. Where it is soft, ripples hold a descent up well before the minimum
    of what lies beneath. With `valley` the search goes on: along each of the three directions of least curvature, to
    the minimum of the parabola through the values there and so far to both sides, where ripples weigh little.
    """

    max_iterations: int = 20  # per start
    tol_x: float = 1e-4  # length of a step, in units of the scales
    tol_f: float = 1e-7  # improvement that a step promises
    candidates: int = 0
    starts: int = 1
    valley: float = 0.0  # half-length of the parabolas along the softest directions, in units of the scales; 0: none

    def __post_init__(self) -> None:
        check_within(
            self,
            max_iterations=(1, 10_000),
            tol_x=(0, 1),
            tol_f=(0, 1e6),
            candidates=(0, 10**6),
            starts=(1, 10_000),
            valley=(0, 100),
        )

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        """Minimise over deltas (n,), from zero and from random starts. Evaluations count quadratics and values alike.

        Raises `TypeError` for an objective without derivatives, one that is no `SmoothObjective`.
        """
        if not isinstance(objective, SmoothObjective):
            raise TypeError("Levenberg–Marquardt needs a SmoothObjective")
        track = BestSoFar(objective)
        starts = torch.zeros(1, n, dtype=torch.float64)
        if self.candidates:
            generator = torch.Generator().manual_seed(seed)
            drawn = torch.randn(self.candidates, n, generator=generator, dtype=torch.float64)
            tried = torch.cat([starts, drawn])
            starts = tried[track(tried).argsort()[: self.starts]]
        found: list[_End] = []
        for start in starts:
            end = _descend(track, objective, start, self, found)
            found += [] if end is None else [end]
        best = min(found, key=lambda end: end.value)
        ends = tuple((end.value, tuple(end.delta.tolist())) for end in found) if len(found) > 1 else ()
        result = replace(track.result(best.stop), ends=ends)
        return _in_the_valley(track, result, best.hessian, self.valley) if self.valley else result


@dataclass(frozen=True, eq=False)
class _End:
    """Where a descent ended, and why."""

    stop: Stop
    value: float
    delta: torch.Tensor  # (n,)
    hessian: torch.Tensor  # (n, n) there


def _descend(
    track: BestSoFar,
    objective: SmoothObjective,
    start: torch.Tensor,
    settings: LevenbergMarquardt,
    earlier: Sequence[_End],
) -> _End | None:
    """Where a descent from one start leads; None if that is where an earlier one ended."""
    here, model = start, _quadratic(track, objective, start)
    damping, growth, longest = _DAMPING, 2.0, _LONGEST
    for _ in range(settings.max_iterations):
        if any(model.value >= end.value and float((here - end.delta).norm()) < _SAME for end in earlier):
            return None
        step = _damped_step(model, damping)
        while float(step.norm()) > longest:
            damping, growth = damping * growth, growth * 2
            if damping > _MOST_DAMPING:
                return _End(Stop.ROUNDOFF, model.value, here, model.hessian)
            step = _damped_step(model, damping)
        promised = float(-(model.gradient @ step) - 0.5 * step @ model.hessian @ step)
        if float(step.norm()) < settings.tol_x:
            return _End(Stop.SMALL_STEP, model.value, here, model.hessian)
        if promised < settings.tol_f:
            return _End(Stop.FLAT, model.value, here, model.hessian)
        trial = _quadratic(track, objective, here + step)
        ratio = (model.value - trial.value) / promised
        if ratio > 0:
            here, model = here + step, trial
            damping = max(_LEAST_DAMPING, damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3))
            growth, longest = 2.0, _LONGEST
        else:
            longest = _SHORTER * float(step.norm())
    return _End(Stop.BUDGET, model.value, here, model.hessian)


def _damped_step(model: Quadratic, damping: float) -> torch.Tensor:
    """The step (n,) to the minimum of the damped quadratic.

    By Marquardt's scaling: a stiff degree of freedom does not hold back a soft one, such as a small object's.
    """
    diagonal = model.hessian.diagonal()
    unit = diagonal.clamp(min=_SOFTEST * float(diagonal.mean()) + 1e-12)
    return -torch.linalg.solve(model.hessian + damping * unit.diag(), model.gradient)


def _in_the_valley(track: BestSoFar, result: Result, hessian: torch.Tensor, half_length: float) -> Result:
    """The result moved along each of the softest directions to the minimum of the parabola through three values."""
    softest = torch.linalg.eigh(hessian).eigenvectors.T[:_SOFT]
    aside = half_length * softest / softest.abs().amax(1, keepdim=True)
    below, above = track(torch.cat([result.delta - aside, result.delta + aside])).double().chunk(2)
    slope, bend = (above - below) / 2, above + below - 2 * result.value
    # Where nothing but rounding bends the values, no data hold the direction.
    way = torch.where(bend > _FLAT, -slope / bend.clamp(min=_FLAT), torch.zeros_like(bend)).clamp(-1, 1)
    delta = result.delta + way @ aside
    value = float(track(delta[None])[0])
    trace = (*result.trace, (track.evaluations, value, tuple(delta.tolist())))
    return replace(result, delta=delta, value=value, evaluations=track.evaluations, trace=trace)


def _quadratic(track: BestSoFar, objective: SmoothObjective, delta: torch.Tensor) -> Quadratic:
    model = objective.quadratic(delta)
    track.count(delta, model.value)
    return model
