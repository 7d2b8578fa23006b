"""A plan: the free optimum of the cement, one drill path that comes near it, and what both are worth."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.curve import Curve
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.distribution import Distribution, Mechanism, mechanism, optimise
from femoreg_torch.planning.path import Clearances, Path, Planner, Surroundings, Worth, joined, places
from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class FemoroplastyPlan:
    """What is to be drilled and injected, and the loads of the femur without cement, at the optimum, and as planned."""

    volume_ml: float
    optimum: Distribution  # its loads are those of the elements on which it was sought
    path: Path
    clearances: Clearances
    cement: Array  # (X, Y, Z) share of the voxels' pores, after diffusion
    baseline: Curve  # without cement
    curve: Curve  # with that cement
    optimum_curve: Curve  # with that of the free optimum
    tried_n: tuple[float, ...]  # yield loads of the paths that were sought on coarse elements, in order
    compared_n: tuple[float, ...]  # of the best of them, and of those sought on finer elements, by which loads are told

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
    """A path that was found, what it injects, and what that is worth."""

    parameters: Array
    path: Path
    cement: Array
    curve: Curve


def make_plan(
    prepared: Prepared, volume_ml: float, seed: int, progress: Progress = lambda step, share: None
) -> FemoroplastyPlan:
    """Optimum, path, diffusion; then paths anew, which also withstand the ways in which the last ones gave way.

    A femur gives way in head, neck or trochanter, whichever is weakest, so cement that serves one mechanism alone gains
    little. The search for a path takes the least load over all mechanisms that were seen so far, an upper bound of what
    the path is worth; the whole model then tells its worth, and by which mechanism it fails.

    A search finds what its own elements make too much of: paths sought on elements of 3 mm gained 27 to 39 % on them,
    and up to five points less on those of 1.5 mm. So optimum and paths are sought on coarse elements first, those of
    `mesh.search_mm`. The best `path.compared` of the paths are looked at on finer ones, those of `prepared`, and from
    the best of these `path.fine` more are sought there. What bears most on the finer elements is the plan, and all its
    loads are told by them. Same seed, same plan. Raises `InputError` if the volume does not fit or no path keeps its
    limits.
    """
    planning = prepared.planning
    bone, settings = prepared.bone, planning.path
    coarse = _Seen(prepared.on_elements(planning.mesh.search_mm), [])
    optimum = optimise(
        bone,
        coarse.prepared.model,
        coarse.prepared.press,
        volume_ml,
        planning,
        lambda share: progress("optimal cement", 0.25 * share),
    )
    coarse.mechanisms.extend(optimum.mechanisms)
    around = Surroundings(bone)
    rng = np.random.default_rng(seed)
    searches = 1 + settings.polish + settings.fine

    def sought(n: int, worth: Worth, start: _Tried | None) -> tuple[Array, Path]:
        planner = Planner(around, worth, volume_ml, settings)
        report = _within(progress, n / searches, 1 / searches)
        x = planner.search(rng, report, None if start is None else start.parameters)
        return x, planner.path(x)

    def tried_on(seen: _Seen, x: Array, path: Path) -> _Tried:
        cement = diffuse(bone, path.injections(), planning.diffusion)
        return _Tried(x, path, cement, seen.look_at(cement))

    tried: list[_Tried] = []
    for n in range(1 + settings.polish):
        start = max(tried, key=_load) if tried else None
        tried.append(tried_on(coarse, *sought(n, coarse.worth(), start)))
    fine = _Seen(prepared, [])
    baseline, optimum_curve = fine.look_at(None), fine.look_at(optimum.cement)
    compared = [
        dataclasses.replace(each, curve=fine.look_at(each.cement))
        for each in sorted(tried, key=_load, reverse=True)[: settings.compared]
    ]
    for n in range(settings.fine):
        worth = joined(coarse.worth(), fine.worth())
        compared.append(tried_on(fine, *sought(1 + settings.polish + n, worth, max(compared, key=_load))))
    best = max(compared, key=_load)
    return FemoroplastyPlan(
        volume_ml,
        optimum,
        best.path,
        around.clearances(best.path, settings),
        best.cement,
        baseline,
        best.curve,
        optimum_curve,
        tuple(_load(each) for each in tried),
        tuple(_load(each) for each in compared),
    )


@dataclass(frozen=True, eq=False)
class _Seen:
    """A femur on elements of one size, and the ways in which it was seen to give way, first without cement."""

    prepared: Prepared
    mechanisms: list[Mechanism]

    def look_at(self, cement: Array | None) -> Curve:
        """The curve with that cement, whose mechanism joins the others."""
        curve = self.prepared.curve(cement)
        self.mechanisms.append(mechanism(curve, self.prepared.material(cement)))
        return curve

    def worth(self) -> Worth:
        """What cement is worth against each of them."""
        return places(self.prepared.bone, self.prepared.model, self.mechanisms, self.prepared.planning.cement)


def _within(progress: Progress, begun: float, share: float) -> Callable[[float], None]:
    """Progress of one search, as a part of that of all."""
    return lambda part: progress("path", 0.35 + 0.65 * (begun + share * part))


def _load(tried: _Tried) -> float:
    return tried.curve.yield_load_n


def until_yield(prepared: Prepared) -> Prepared:
    """The same, with curves that end at the yield load: what errors of a plan need, in half the time."""
    short = dataclasses.replace(prepared.planning.curve, stop_stiffness=1.0)
    return dataclasses.replace(prepared, planning=dataclasses.replace(prepared.planning, curve=short))
