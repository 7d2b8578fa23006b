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
    optimum: Distribution  # its loads are those of the elements of the search
    path: Path
    clearances: Clearances
    cement: Array  # (X, Y, Z) share of the voxels' pores, after diffusion
    baseline: Curve  # without cement
    curve: Curve  # with that cement
    optimum_curve: Curve  # with that of the free optimum
    tried_n: tuple[float, ...]  # yield loads of the paths that were tried, in order, on the elements of the search
    compared_n: tuple[float, ...]  # of the best of them, from the best on

    @property
    def gain(self) -> float:
        """Yield load with cement over that without, minus 1."""
        return self.curve.yield_load_n / self.baseline.yield_load_n - 1

    @property
    def optimum_gain(self) -> float:
        """The same of the free optimum."""
        return self.optimum_curve.yield_load_n / self.baseline.yield_load_n - 1


@dataclass(frozen=True, eq=False)
class _Tried:
    """A path that was found, what it injects, and what it is worth on the elements of the search."""

    parameters: Array
    path: Path
    cement: Array
    load_n: float


def make_plan(
    prepared: Prepared, volume_ml: float, seed: int, progress: Progress = lambda step, share: None
) -> FemoroplastyPlan:
    """Optimum, path, diffusion; then paths anew, which also withstand the way in which the last one gave way.

    A femur gives way in head, neck or trochanter, whichever is weakest, so cement that serves one mechanism alone gains
    little. The search for a path takes the least load over all mechanisms that were seen so far, an upper bound of what
    the path is worth; the whole model then tells its worth, and by which mechanism it fails.

    A search finds what its own elements make too much of: on a real femur a path gained 35 % on elements of 3 mm, on
    which it was sought, and 31 % on those of 2 and 1.5 mm. So the best `path.compared` paths are compared on finer
    elements, those of `prepared`, and all loads of the plan are told by them. Same seed, same plan. Raises `InputError`
    if the volume does not fit or no path keeps its limits.
    """
    planning = prepared.planning
    searched = prepared.on_elements(planning.mesh.search_mm)
    bone, model = searched.bone, searched.model
    rng = np.random.default_rng(seed)
    optimum = optimise(
        bone, model, searched.press, volume_ml, planning, lambda share: progress("optimal cement", 0.35 * share)
    )
    around = Surroundings(bone)
    mechanisms = list(optimum.mechanisms)
    tried: list[_Tried] = []
    searches = 1 + planning.path.polish
    for n in range(searches):
        worth = places(bone, model, mechanisms, planning.cement)
        planner = Planner(around, worth, volume_ml, planning.path)
        start = max(tried, key=_load).parameters if tried else None
        x = planner.search(rng, _within(progress, n / searches, 1 / searches), start)
        path = planner.path(x)
        cement = diffuse(bone, path.injections(), planning.diffusion)
        material = with_cement(model, bone, cement, planning.cement)
        curve = searched.press.curve(material, planning.curve)
        tried.append(_Tried(x, path, cement, curve.yield_load_n))
        mechanisms.append(mechanism(curve, material))
    best = sorted(tried, key=_load, reverse=True)[: planning.path.compared]
    told = []
    for n, placed in enumerate([None, optimum.cement, *(each.cement for each in best)]):
        told.append(prepared.curve(placed))
        progress("loads on finer elements", 0.7 + 0.3 * (n + 1) / (2 + len(best)))
    baseline, optimum_curve, *curves = told
    loads = tuple(curve.yield_load_n for curve in curves)
    first = int(np.argmax(loads))
    chosen = best[first]
    return FemoroplastyPlan(
        volume_ml,
        optimum,
        chosen.path,
        around.clearances(chosen.path, planning.path),
        chosen.cement,
        baseline,
        curves[first],
        optimum_curve,
        tuple(_load(each) for each in tried),
        loads,
    )


def _within(progress: Progress, begun: float, share: float) -> Callable[[float], None]:
    """Progress of one search, as a part of that of all."""
    return lambda part: progress("path", 0.35 + 0.35 * (begun + share * part))


def _load(tried: _Tried) -> float:
    return tried.load_n


def until_yield(prepared: Prepared) -> Prepared:
    """The same, with curves that end at the yield load: what errors of a plan need, in half the time."""
    short = dataclasses.replace(prepared.planning.curve, stop_stiffness=1.0)
    return dataclasses.replace(prepared, planning=dataclasses.replace(prepared.planning, curve=short))
