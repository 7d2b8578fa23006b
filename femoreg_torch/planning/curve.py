"""The load–displacement curve of a femur, and where on it the bone yields."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError
from femoreg_torch.planning.element import TENSOR, elastic_stiffness, moduli, template
from femoreg_torch.planning.laws import Material
from femoreg_torch.planning.loading import Loading
from femoreg_torch.planning.mesh import Mesh
from femoreg_torch.planning.plasticity import Plasticity, State
from femoreg_torch.planning.settings import CurveSettings
from femoreg_torch.planning.system import Assembler, Solver

Array = NDArray[np.float64]

_LINEAR_TOLERANCE = 1e-8  # of the elastic solution
_NEWTON_TOLERANCE = 1e-2  # of a step's linear system; balance itself is asked for by `tolerance`
_SMALLEST_STEP = 1 / 16  # of the step


@dataclass(frozen=True, eq=False)
class Point:
    """One point of the curve: the pad's displacement mm, the force N, the bone's state."""

    displacement_mm: float
    load_n: float
    u: Array  # (N, 3) mm
    state: State
    newton: int  # iterations spent


@dataclass(frozen=True, eq=False)
class Curve:
    """Load over displacement and what follows from it."""

    displacement_mm: Array
    load_n: Array
    stiffness_n_mm: float  # the first
    yield_load_n: float
    yield_mm: float
    yield_energy_nmm: float  # area below the curve up to there
    plastic: Array  # (E, 8) equivalent plastic strain at the end
    last: Point
    newton: int

    @property
    def most_n(self) -> float:
        """The greatest load reached."""
        return float(self.load_n.max())


class Press:
    """A femur under its pads: mesh, loading and the pattern of the matrix, which serve any material.

    On `device` its linear systems are solved.
    """

    def __init__(self, mesh: Mesh, loading: Loading, poisson: float, device: torch.device = CPU) -> None:
        self.mesh, self.loading, self.device = mesh, loading, device
        self._poisson = poisson
        self._assembler = Assembler(mesh)

    def hardened(self, material: Material) -> Material:
        """The material with caps that do not yield and are no softer than the pads."""
        caps = self.loading.caps
        return Material(
            np.maximum(material.modulus, self.loading.cap_modulus),
            np.where(caps, np.inf, material.tension),
            np.where(caps, np.inf, material.compression),
        )

    def elastic(self, material: Material) -> tuple[Array, float, Solver]:
        """Displacements (N, 3) for a pad moved by 1 mm, the stiffness N/mm, and the solver that found them."""
        hard = self.hardened(material)
        stiffness = elastic_stiffness(hard.modulus, self._poisson) * self.mesh.size_mm
        matrix = self._assembler.matrix(stiffness, self.loading.springs)
        solver = Solver(matrix, self.mesh.nodes, self.device)
        u = solver.solve(matrix, self.loading.push(1.0).ravel(), _LINEAR_TOLERANCE).reshape(-1, 3)
        return u, self.loading.load(1.0, u), solver

    def energy(self, material: Material, u: Array) -> Array:
        """Elastic strain energy (E, 8) of the eighths of elements at displacements (N, 3), N mm."""
        strained = self._assembler.gather(u) / self.mesh.size_mm
        made, (bulk, shear) = template(), moduli(self._poisson)
        deviator = (strained @ made.deviator.reshape(48, 24).T).reshape(-1, 8, 6)
        density = bulk / 2 * (strained @ made.dilatation)[:, None] ** 2 + shear * (deviator**2 @ TENSOR)
        return np.asarray(density * self.hardened(material).modulus * self.mesh.size_mm**3 / 8)

    def curve(self, material: Material, settings: CurveSettings) -> Curve:
        """The curve until the bone has yielded. Raises `InputError` where it does not converge or never yields.

        Each step is solved by Newton's method with the consistent tangent. The curve ends when the rule of the yield
        load is fulfilled and the slope is below `stop_stiffness` of the first.
        """
        unit, stiffness, solver = self.elastic(material)
        law = Plasticity(self.hardened(material), self._poisson)
        start = Point(0.0, 0.0, np.zeros_like(unit), law.fresh(), 0)
        points = [start]
        step = target = settings.step_mm
        newton = 0
        while True:
            before = points[-1]
            guess = (
                unit * target
                if before is start
                else before.u + (target - before.displacement_mm) * (unit if len(points) < 3 else _slope(points))
            )
            found = self._newton(law, solver, guess, before.state, target, settings)
            if found is None:
                step /= 2
                if step < settings.step_mm * _SMALLEST_STEP:
                    raise InputError(
                        f"solver: the bone does not come to rest at a displacement of {target:.2f} mm. Use smaller "
                        "steps (curve.step_mm), or check label and calibration."
                    )
                target = before.displacement_mm + step
                continue
            newton += found.newton
            points.append(found)
            slope = (found.load_n - before.load_n) / (found.displacement_mm - before.displacement_mm) / stiffness
            if slope < settings.stop_stiffness and self._fulfilled(points, stiffness, settings):
                break
            target = found.displacement_mm + step
            if target > settings.longest_mm:
                raise InputError(
                    f"solver: the bone has not yielded at {settings.longest_mm:g} mm (curve.longest_mm), its load is "
                    f"{found.load_n:.0f} N. Check label and calibration."
                )
        return self._finished(law, solver, points, stiffness, newton, material, unit, settings)

    def _newton(
        self, law: Plasticity, solver: Solver, u: Array, before: State, target: float, settings: CurveSettings
    ) -> Point | None:
        """Balance at one displacement, or None if it is not found."""
        size = self.mesh.size_mm
        push = self.loading.push(target)
        for n in range(settings.newton_steps):
            response = law.respond(self._assembler.gather(u), size, before)
            inside = self._assembler.scatter(response.force * size**2)
            residual = push - inside
            residual -= np.einsum("nij,nj->ni", self.loading.springs, u)
            load = self.loading.load(target, u)
            # A stiff pad pushes by far more than the load, and takes most of it back.
            if np.linalg.norm(residual) <= settings.tolerance * min(np.linalg.norm(push), np.linalg.norm(inside)):
                return Point(target, load, u, response.state, n)
            matrix = self._assembler.matrix(law.tangent(response) * size, self.loading.springs)
            try:
                u = u + solver.solve(matrix, residual.ravel(), _NEWTON_TOLERANCE).reshape(-1, 3)
            except InputError:  # a smaller step is tried before it is given up
                return None
            if not np.isfinite(u).all():
                return None
        return None

    def _fulfilled(self, points: list[Point], stiffness: float, settings: CurveSettings) -> bool:
        last = points[-1]
        if settings.rule == "displacement":
            return last.displacement_mm >= settings.displacement_share * self.loading.span_mm
        return settings.rule == "pistoia" or last.load_n < stiffness * (last.displacement_mm - settings.offset_mm)

    def _finished(
        self,
        law: Plasticity,
        solver: Solver,
        points: list[Point],
        stiffness: float,
        newton: int,
        material: Material,
        unit: Array,
        settings: CurveSettings,
    ) -> Curve:
        d = np.array([point.displacement_mm for point in points])
        load = np.array([point.load_n for point in points])
        if settings.rule == "pistoia":
            at_load = self._pistoia(material, unit, stiffness, settings)
            at = at_load / stiffness  # a linear model: its displacement is the elastic one
        elif settings.rule == "displacement":
            at = settings.displacement_share * self.loading.span_mm
            at_load = float(np.interp(at, d, load))
        else:
            at, n = _crossing(d, load, stiffness, settings.offset_mm)
            point = self._newton(law, solver, points[n].u, points[n - 1].state, at, settings)
            if point is not None:  # the chord's error is gone: the curve bends between two steps
                d, load = np.insert(d, n, at), np.insert(load, n, point.load_n)
                at, n = _crossing(d, load, stiffness, settings.offset_mm)
            at_load = float(stiffness * (at - settings.offset_mm))
        below = d < at
        energy = float(np.trapezoid(np.append(load[below], at_load), np.append(d[below], at)))
        return Curve(d, load, stiffness, at_load, at, energy, points[-1].state.equivalent, points[-1], newton)

    def _pistoia(self, material: Material, unit: Array, stiffness: float, settings: CurveSettings) -> float:
        """The load at which a share of the volume exceeds a strain, by the linear solution (Pistoia et al. 2002).

        Strain is the energy-equivalent sqrt(2 U / E) with U the energy density.
        """
        modulus = self.hardened(material).modulus.mean(1)
        strain = np.sqrt(2 * self.energy(material, unit).sum(1) / (modulus * self.mesh.size_mm**3))
        strain = strain[~self.loading.caps.any(1)]
        return float(stiffness * settings.pistoia_strain / np.quantile(strain, 1 - settings.pistoia_share))


def _slope(points: list[Point]) -> Array:
    """Displacements (N, 3) gained per mm of the pad in the last step."""
    before, last = points[-2:]
    return np.asarray((last.u - before.u) / (last.displacement_mm - before.displacement_mm))


def _crossing(d: Array, load: Array, stiffness: float, offset_mm: float) -> tuple[float, int]:
    """Where the shifted line meets the curve, and the index of the first point beyond it."""
    gap = load - stiffness * (d - offset_mm)
    n = int(np.argmax(gap < 0))
    share = gap[n - 1] / (gap[n - 1] - gap[n])
    return float(d[n - 1] + share * (d[n] - d[n - 1])), n
