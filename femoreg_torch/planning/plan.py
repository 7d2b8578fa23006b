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
    tried_n: tuple[float, ...]  # yield loads of the paths that were tried, in order

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

    The free optimum, which tells the first mechanisms, is sought on the coarse elements of `mesh.optimum_mm`. Paths are
    not: a search finds what its own elements make too much of, and a path sought on elements of 3 mm gained 35 % on
    them and 31 % on those of 2 and 1.5 mm. Same seed, same plan. Raises `InputError` if the volume does not fit or no
    path keeps its limits.
    """
    planning = prepared.planning
    coarse = prepared.on_elements(planning.mesh.optimum_mm)
    optimum = optimise(
        prepared.bone,
        coarse.model,
        coarse.press,
        volume_ml,
        planning,
        lambda share: progress("optimal cement", 0.25 * share),
    )
    seen = _Seen(prepared, [])
    baseline, optimum_curve = seen.look_at(None), seen.look_at(optimum.cement)
    known = _Seen(coarse, list(optimum.mechanisms)).worth()
    around = Surroundings(prepared.bone)
    rng = np.random.default_rng(seed)
    tried: list[_Tried] = []
    searches = 1 + planning.path.polish
    for n in range(searches):
        planner = Planner(around, joined(known, seen.worth()), volume_ml, planning.path)
        start = max(tried, key=_load).parameters if tried else None
        x = planner.search(rng, _within(progress, n / searches, 1 / searches), start)
        path = planner.path(x)
        cement = diffuse(prepared.bone, path.injections(), planning.diffusion)
        tried.append(_Tried(x, path, cement, seen.look_at(cement)))
    best = max(tried, key=_load)
    return FemoroplastyPlan(
        volume_ml,
        optimum,
        best.path,
        around.clearances(best.path, planning.path),
        best.cement,
        baseline,
        best.curve,
        optimum_curve,
        tuple(_load(each) for each in tried),
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
