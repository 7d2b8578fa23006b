"""A plan: the free optimum of the cement, one drill path that comes near it, and what both are worth."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.curve import Curve
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.distribution import Distribution, mechanism, optimise
from femoreg_torch.planning.model import with_cement
from femoreg_torch.planning.path import Clearances, Path, Planner, Surroundings, places
from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class FemoroplastyPlan:
    """What is to be drilled and injected, and the loads of the femur without cement, at the optimum, and as planned."""

    volume_ml: float
    optimum: Distribution
    path: Path
    clearances: Clearances
    cement: Array  # (X, Y, Z) share of the voxels' pores, after diffusion
    curve: Curve  # with that cement
    polished: tuple[float, ...]  # yield loads of the paths that were tried, in order

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
    """Optimum, path, diffusion; then paths anew, which also withstand the way in which the last one gave way.

    A femur gives way in head, neck or trochanter, whichever is weakest, so cement that serves one mechanism alone gains
    little. The search for a path takes the least load over all mechanisms that were seen so far, an upper bound of what
    the path is worth; the whole model then tells its worth, and by which mechanism it fails. The best one counts.
    Same seed, same plan. Raises `InputError` if the volume does not fit or no path keeps its limits.
    """
    bone, model, planning = prepared.bone, prepared.model, prepared.planning
    rng = np.random.default_rng(seed)
    optimum = optimise(
        bone, model, prepared.press, volume_ml, planning, lambda share: progress("optimal cement", 0.5 * share)
    )
    around = Surroundings(bone)
    mechanisms = list(optimum.mechanisms)
    tried: list[tuple[Array, Path, Array, Curve]] = []
    searches = 1 + planning.path.polish
    for n in range(searches):
        worth = places(bone, model, mechanisms, planning.cement)
        planner = Planner(around, worth, volume_ml, planning.path)
        start = max(tried, key=_load)[0] if tried else None
        x = planner.search(rng, _within(progress, n / searches, 1 / searches), start)
        path = planner.path(x)
        cement = diffuse(bone, path.injections(), planning.diffusion)
        material = with_cement(model, bone, cement, planning.cement)
        tried.append((x, path, cement, prepared.press.curve(material, planning.curve)))
        mechanisms.append(mechanism(tried[-1][3], material))
    _, path, cement, curve = max(tried, key=_load)
    clearances = around.clearances(path, planning.path)
    loads = tuple(_load(each) for each in tried)
    return FemoroplastyPlan(volume_ml, optimum, path, clearances, cement, curve, loads)


def _within(progress: Progress, begun: float, share: float) -> Callable[[float], None]:
    """Progress of one search, as a part of the second half of all."""
    return lambda part: progress("path", 0.5 + 0.5 * (begun + share * part))


def _load(tried: tuple[Array, Path, Array, Curve]) -> float:
    return tried[3].yield_load_n


def until_yield(prepared: Prepared) -> Prepared:
    """The same, with curves that end at the yield load: what errors of a plan need, in half the time."""
    short = dataclasses.replace(prepared.planning.curve, stop_stiffness=1.0)
    return dataclasses.replace(prepared, planning=dataclasses.replace(prepared.planning, curve=short))
