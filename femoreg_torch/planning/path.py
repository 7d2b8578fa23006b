"""One drill path with ellipsoids of cement along it, that covers what is worth most under constraints."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import differential_evolution

from femoreg_torch.errors import InputError
from femoreg_torch.planning.diffusion import Injection
from femoreg_torch.planning.distribution import Mechanism
from femoreg_torch.planning.femur import Frame
from femoreg_torch.planning.mesh import blocks
from femoreg_torch.planning.model import Bone, Model
from femoreg_torch.planning.settings import CementSettings, PathSettings

Array = NDArray[np.float64]

_STEP_MM = 0.5  # along a ray
_LONGEST_MM = 160.0
_NECK_MM = 45.0  # from the head's centre: so far the axis of the neck stays farthest from the surface
_NECK_CONE_DEG = 25.0
_GRID_MM = 3.0  # places whose worth is added up
_POPULATION = 8  # of the search, times the number of parameters


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """Cement around the path: turned about it, its middle at a depth from the entry point."""

    depth_mm: float
    along_mm: float  # semi-axes
    across_mm: float
    volume_ml: float  # of cement, its part of the whole


@dataclass(frozen=True, eq=False)
class Path:
    """A straight path, LPS mm, and the cement along it, from deep to shallow."""

    entry: Array  # (3,)
    target: Array  # (3,) where the drill stops
    ellipsoids: tuple[Ellipsoid, ...] = ()

    @property
    def length_mm(self) -> float:
        """From entry point to target."""
        return float(np.linalg.norm(self.target - self.entry))

    @property
    def direction(self) -> Array:
        """Unit vector (3,) from the entry point to the target."""
        return np.asarray((self.target - self.entry) / self.length_mm)

    def injections(self) -> list[Injection]:
        """What is injected, in order."""
        return [Injection(self.entry + e.depth_mm * self.direction, e.volume_ml) for e in self.ellipsoids]


@dataclass(frozen=True)
class Clearances:
    """What a path keeps away from, and what its limits are."""

    cortex_mm: float  # of the path to the surface, but near the entry
    head_mm: float  # of its end to the surface
    entry_angle_deg: float  # to the normal of the surface
    entry_below_mm: float  # below the head's centre
    target_from_head_mm: float
    neck_angle_deg: float

    def excess(self, settings: PathSettings) -> float:
        """By how much limits are broken, in their own units, summed up; 0 where all are kept."""
        broken = (
            settings.clearance_mm - self.cortex_mm,
            settings.tip_clearance_mm - self.head_mm,
            self.entry_angle_deg - settings.entry_angle_deg,
            self.entry_below_mm - settings.lowest_entry_mm,
            self.target_from_head_mm - settings.target_mm,
            self.neck_angle_deg - settings.angle_deg,
        )
        return float(sum(max(0.0, value - 1e-9) for value in broken))


class Surroundings:
    """A bone as a path sees it: depth beneath the surface, the axis of its neck."""

    def __init__(self, bone: Bone) -> None:
        self.frame: Frame = bone.femur.frame
        self._femur = bone.femur
        self._depth = bone.femur.depth()
        smooth = ndimage.gaussian_filter(self._depth, 2.0 / bone.femur.spacing)
        self._slopes = np.stack(np.gradient(smooth, *bone.femur.spacing))
        self.neck = self._neck_axis()

    def depth(self, points: Array) -> Array:
        """mm beneath the surface (…) of points (…, 3); outside the CT's box −10."""
        index = np.moveaxis(self._femur.index(points), -1, 0)
        return np.asarray(ndimage.map_coordinates(self._depth, index, order=1, mode="constant", cval=-10.0))

    def entry(self, target: Array, outward: Array) -> Array | None:
        """Where a ray (3,) from the target first leaves the bone, or None if it does not within its length."""
        along = np.arange(0.0, _LONGEST_MM, _STEP_MM)
        depth = self.depth(target + along[:, None] * outward)
        if depth[0] <= 0 or not (depth <= 0).any():
            return None
        n = int(np.argmax(depth <= 0))
        share = depth[n - 1] / (depth[n - 1] - depth[n])
        return np.asarray(target + (along[n - 1] + share * _STEP_MM) * outward)

    def clearances(self, path: Path, settings: PathSettings) -> Clearances:
        """What the path keeps away from."""
        depths = np.arange(settings.entry_free_mm, path.length_mm, 1.0)
        inside = path.entry + depths[:, None] * path.direction
        index = self._femur.index(path.entry)[:, None]
        slope = np.array([ndimage.map_coordinates(part, index, order=1, mode="nearest")[0] for part in self._slopes])
        inward = self._femur.axes @ slope
        cosine = float(inward @ path.direction / max(float(np.linalg.norm(inward)), 1e-9))
        return Clearances(
            cortex_mm=float(self.depth(inside).min()) if len(inside) else -10.0,
            head_mm=float(self.depth(path.target[None])[0]),
            entry_angle_deg=math.degrees(math.acos(np.clip(cosine, -1, 1))),
            entry_below_mm=float((self.frame.head - path.entry) @ self.frame.proximal),
            target_from_head_mm=float(np.linalg.norm(path.target - self.frame.head)),
            neck_angle_deg=math.degrees(math.acos(np.clip(-path.direction @ self.neck, -1, 1))),
        )

    def _neck_axis(self) -> Array:
        """The direction from the head's centre in which the surface stays farthest, near 45° to the shaft."""
        first = self.frame.neck
        second = np.cross(first, self.frame.posterior)
        angles = np.radians(np.arange(-_NECK_CONE_DEG, _NECK_CONE_DEG + 1, 2.5))
        tilted = [first + math.tan(a) * second + math.tan(b) * self.frame.posterior for a in angles for b in angles]
        directions = np.array([v / np.linalg.norm(v) for v in tilted])
        along = np.arange(15.0, _NECK_MM, 1.0)
        depth = self.depth(self.frame.head + along[None, :, None] * directions[:, None])
        return np.asarray(directions[int(depth.min(1).argmax())])


def central_path(around: Surroundings, volume_ml: float, settings: PathSettings) -> Path:
    """The path without a plan: along the neck's axis to the head's centre, a third of the cement at each quarter.

    What a planned path is compared with (choice). Raises `InputError` if the axis of the neck does not leave the bone.
    """
    target = around.frame.head
    entry = around.entry(target, around.neck)
    if entry is None:
        raise InputError("path: the axis of the neck does not leave the bone. Check label and head centre.")
    length = float(np.linalg.norm(target - entry))
    axis = settings.least_axis_mm
    return Path(
        entry, target, tuple(Ellipsoid(length * share, axis, axis, volume_ml / 3) for share in (0.75, 0.5, 0.25))
    )


@dataclass(frozen=True, eq=False)
class Worth:
    """Places in the marrow: where (N, 3), LPS mm, how much cement each takes (ml), and what it is worth.

    Of each of K mechanisms: the load `base` (K,) that bone alone bears against it, over the load without cement, and
    what a ml of cement in each place adds, `worth` (K, N).
    """

    points: Array
    room_ml: Array
    base: Array
    worth: Array

    def load(self, room_ml: Array) -> float:
        """The least load of all mechanisms with cement (N,) in ml, over the load without cement."""
        return float((self.base + self.worth @ room_ml).min())


def joined(first: Worth, second: Worth) -> Worth:
    """The same places, with the mechanisms of both."""
    base, worth = np.concatenate([first.base, second.base]), np.concatenate([first.worth, second.worth])
    return Worth(first.points, first.room_ml, base, worth)


def covered(
    path_direction: Array, middles: Array, axes: Array, worth: Worth, volume_ml: float
) -> tuple[Array, Array, float]:
    """Which places (N,) a volume of cement in ellipsoids fills, which ellipsoid each is of, and the axes' scale.

    `middles` (K, 3) lie on one line along the path. `axes` (K, 2), along and across, are scaled together until just the
    volume is in the marrow.
    """
    offset = worth.points - middles[0]
    along = offset @ path_direction
    across = np.maximum(np.einsum("ni,ni->n", offset, offset) - along**2, 0)  # squared, from the line
    beside = along - ((middles - middles[0]) @ path_direction)[:, None]
    squared = (beside / axes[:, :1]) ** 2 + across / axes[:, 1:] ** 2  # (K, N)
    nearest = squared.argmin(0)
    least = squared.min(0)
    order = np.argsort(least)
    sums = np.cumsum(worth.room_ml[order])
    last = min(int(np.searchsorted(sums, volume_ml)), len(order) - 1)
    filled = np.zeros(len(order), bool)
    filled[order[: last + 1]] = True
    return filled, nearest, math.sqrt(least[order[last]])


def apart_mm(ellipsoids: Sequence[Ellipsoid]) -> float:
    """How far injections, from deep to shallow, are from being one body of cement, mm; 0 where they are.

    What is injected at one place spreads to about a ball, whatever its ellipsoid: so balls must touch. A gap of bone
    between two bodies gives way, and elements as wide as it do not see that.
    """
    radii = [(3000 * e.volume_ml / (4 * math.pi)) ** (1 / 3) for e in ellipsoids]
    gaps = [
        deep.depth_mm - shallow.depth_mm - a - b
        for (deep, a), (shallow, b) in pairwise(zip(ellipsoids, radii, strict=True))
    ]
    return sum(max(0.0, gap) for gap in gaps)


class Planner:
    """The search for a path: its parameters, what they mean, and what they are worth."""

    def __init__(self, around: Surroundings, worth: Worth, volume_ml: float, settings: PathSettings) -> None:
        self.around, self.settings = around, settings
        self._worth, self._volume = worth, volume_ml
        neck = around.neck
        side = np.cross(neck, around.frame.posterior)
        self._side = side / np.linalg.norm(side)
        self._front = np.cross(self._side, neck)
        low, high = math.log(settings.least_axis_mm), math.log(settings.most_axis_mm)
        count = settings.ellipsoids
        reach = settings.target_mm / math.sqrt(3)
        tilt = math.tan(math.radians(settings.angle_deg)) / math.sqrt(2)
        self.bounds = [(-reach, reach)] * 3 + [(-tilt, tilt)] * 2 + [(0.02, 0.85)] * count + [(low, high)] * 2 * count

    def drilled(self, x: Array) -> Path | None:
        """The path of parameters, without cement; None if it does not leave the bone."""
        target = self.around.frame.head + x[0] * self.around.neck + x[1] * self._side + x[2] * self._front
        outward = self.around.neck + x[3] * self._side + x[4] * self._front
        entry = self.around.entry(target, outward / np.linalg.norm(outward))
        return None if entry is None else Path(entry, target)

    def filled(self, x: Array, path: Path) -> tuple[Path, float]:
        """The path with the cement of the parameters, and the load that mechanisms allow, over that of bone alone."""
        count, settings, length, outward = self.settings.ellipsoids, self.settings, path.length_mm, -path.direction
        middles = path.target + (x[5 : 5 + count] * length)[:, None] * outward
        axes = np.exp(x[5 + count :]).reshape(count, 2)
        filled, nearest, scale = covered(outward, middles, axes, self._worth, self._volume)
        room = np.where(filled, self._worth.room_ml, 0.0)
        parts = np.bincount(nearest, room, count)
        parts *= self._volume / parts.sum()
        scaled = axes * scale
        outside = (
            np.maximum(scaled - settings.most_axis_mm, 0).sum() + np.maximum(settings.least_axis_mm - scaled, 0).sum()
        )
        made = [
            Ellipsoid(length * (1 - share), float(axis[0]), float(axis[1]), float(part))
            for share, axis, part in zip(x[5 : 5 + count], scaled, parts, strict=True)
            if part > 0.01 * self._volume
        ]
        made.sort(key=lambda ellipsoid: -ellipsoid.depth_mm)
        whole = sum(e.volume_ml for e in made)
        kept = [Ellipsoid(e.depth_mm, e.along_mm, e.across_mm, e.volume_ml * self._volume / whole) for e in made]
        value = self._worth.load(room) - 0.1 * (float(outside) + apart_mm(kept))
        return Path(path.entry, path.target, tuple(kept)), value

    def path(self, x: Array) -> Path:
        """The path of parameters that keep all limits, with its cement."""
        drilled = self.drilled(x)
        assert drilled is not None  # limits were kept
        return self.filled(x, drilled)[0]

    def cost(self, x: Array) -> float:
        """What the search makes small: less than 0 where all limits are kept."""
        path = self.drilled(x)
        if path is None:
            return 1000.0
        excess = self.around.clearances(path, self.settings).excess(self.settings)
        return 1.0 + excess if excess > 0 else -self.filled(x, path)[1]

    def search(
        self,
        rng: np.random.Generator,
        progress: Callable[[float], None] = lambda share: None,
        start: Array | None = None,
    ) -> Array:
        """The best parameters (P,) by differential evolution, in a third of the evaluations from a good `start`.

        Raises `InputError` if no path keeps all limits.
        """
        size = _POPULATION * len(self.bounds)
        rounds = max(1, self.settings.evaluations // (1 if start is None else 3) // size - 1)
        done = 0

        def report(intermediate_result: object) -> None:
            nonlocal done
            done += 1
            progress(min(1.0, done / rounds))

        found = differential_evolution(
            self.cost,
            self.bounds,
            maxiter=rounds,
            popsize=_POPULATION,
            x0=start,
            rng=rng,
            tol=1e-4,
            polish=False,
            callback=report,
        )
        if found.fun >= 1.0:
            best = self.drilled(found.x)
            told = "" if best is None else f" The nearest one: {self._told(best)}."
            raise InputError(f"path: none keeps all limits.{told} Relax them under `path`, or plan for another femur.")
        return np.asarray(found.x)

    def _told(self, path: Path) -> str:
        found = self.around.clearances(path, self.settings)
        return (
            f"{found.cortex_mm:.1f} mm to the cortex, {found.head_mm:.1f} mm to the surface of the head, entry "
            f"{found.entry_angle_deg:.0f}° off the normal and {found.entry_below_mm:.0f} mm below the head"
        )


def places(
    bone: Bone, model: Model, mechanisms: Sequence[Mechanism], settings: CementSettings, size_mm: float = _GRID_MM
) -> Worth:
    """Marrow in places of some mm, with what cement there is worth against each mechanism.

    Linear in the cement, as `Mechanism.bound` is, so a little too much for places that are filled in part.
    """
    grid = blocks(bone.femur, size_mm)
    room = grid.mean(bone.pores)
    index = np.argwhere(room > 0.05)
    where = tuple(index.T)
    room_ml = room[where] * size_mm**3 / 1000
    rise = settings.strength_mpa * model.fill - model.material.tension
    alone = mechanisms[0].load_n
    base, worth = [], []
    field = np.zeros((*model.grid.shape, 8))
    for each in mechanisms:
        load, more = each.bound(model.material.tension, rise)
        field[tuple(model.mesh.cells.T)] = more / alone
        density = grid.mean(model.grid.spread_octants(field) * bone.marrow)[where]  # per octant's volume
        base.append(load / alone)
        worth.append(density * 8 * (size_mm / model.mesh.size_mm) ** 3 / room_ml)
    return Worth(grid.centres(index), room_ml, np.array(base), np.array(worth))
