"""A plan: the free optimum of the cement, one drill path that comes near it, and what both are worth."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.curve import Curve
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.distribution import Distribution, optimise
from femoreg_torch.planning.path import Clearances, Path, Planner, Surroundings, places
from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_NUDGE = 0.08  # deviation of a last change, of each parameter's range
_TRIES = 30  # of a change that keeps all limits


@dataclass(frozen=True, eq=False)
class FemoroplastyPlan:
    """What is to be drilled and injected, and the loads of the femur without cement, at the optimum, and as planned."""

    volume_ml: float
    optimum: Distribution
    path: Path
    clearances: Clearances
    cement: Array  # (X, Y, Z) share of the voxels' pores, after diffusion
    curve: Curve  # with that cement
    polished: tuple[float, ...]  # yield loads of the changes that were tried, the first without change

    @property
    def gain(self) -> float:
        """Yield load with cement over that without, minus 1."""
        return self.curve.yield_load_n / self.optimum.baseline.yield_load_n - 1

    @property
    def optimum_gain(self) -> float:
        """The same of the free optimum."""
        return self.optimum.curve.yield_load_n / self.optimum.baseline.yield_load_n - 1


def make_plan(
    prepared: Prepared, volume_ml: float, seed: int, progress: Progress = lambda step, share: None
) -> FemoroplastyPlan:
    """Optimum, path, diffusion; then a few changes of the path, kept where the yield load rises.

    Same seed, same plan. Raises `InputError` if the volume does not fit or no path keeps its limits.
    """
    bone, planning = prepared.bone, prepared.planning
    rng = np.random.default_rng(seed)
    optimum = optimise(
        bone, prepared.model, prepared.press, volume_ml, planning, lambda share: progress("optimal cement", 0.6 * share)
    )
    around = Surroundings(bone)
    worth = places(bone, prepared.model.grid.spread(optimum.worth))
    planner = Planner(around, worth, volume_ml, planning.path)
    x = planner.search(rng, lambda share: progress("path", 0.6 + 0.2 * share))
    short = until_yield(prepared)
    path, cement, curve = _tried(short, planner, x)
    loads = [curve.yield_load_n]
    for n in range(planning.path.polish):
        progress("last changes of the path", 0.8 + 0.2 * n / planning.path.polish)
        changed = _nudged(planner, x, rng)
        if changed is None:
            break
        other, other_cement, other_curve = _tried(short, planner, changed)
        loads.append(other_curve.yield_load_n)
        if other_curve.yield_load_n > curve.yield_load_n:
            x, path, cement, curve = changed, other, other_cement, other_curve
    clearances = around.clearances(path, planning.path)
    return FemoroplastyPlan(volume_ml, optimum, path, clearances, cement, prepared.curve(cement), tuple(loads))


def _tried(prepared: Prepared, planner: Planner, x: Array) -> tuple[Path, Array, Curve]:
    drilled = planner.drilled(x)
    assert drilled is not None  # limits were kept
    path = planner.filled(x, drilled)[0]
    cement = diffuse(prepared.bone, path.injections(), prepared.planning.diffusion)
    return path, cement, prepared.curve(cement)


def _nudged(planner: Planner, x: Array, rng: np.random.Generator) -> Array | None:
    """Parameters nearby that keep all limits, or None if they are not found."""
    low, high = np.array(planner.bounds).T
    for _ in range(_TRIES):
        changed = np.clip(x + rng.normal(size=len(x)) * _NUDGE * (high - low), low, high)
        if planner.cost(changed) < 1:
            return np.asarray(changed)
    return None


def until_yield(prepared: Prepared) -> Prepared:
    """The same, with curves that end at the yield load: what errors of a plan need, in half the time."""
    short = dataclasses.replace(prepared.planning.curve, stop_stiffness=1.0)
    return dataclasses.replace(prepared, planning=dataclasses.replace(prepared.planning, curve=short))
