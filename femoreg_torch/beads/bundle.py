"""Poses of objects and of the C-arm from their beads in all images at once, and how sure they are.

Every object is rigid, and all images of a view are taken by one camera. So an object whose beads are seen in several
views ties these views together, and the views then triangulate every bead. Unknown are the pose of each object in
camera 1, the pose of every other camera, and, as their places in the CT are measured too, small shifts of the beads
themselves, which cost as much as their deviation says (a bundle adjustment: Triggs et al., Vision Algorithms, LNCS 1883
(2000) 298). Levenberg–Marquardt with exact derivatives, weighted by Huber's rule first; shadows that miss by more than
five deviations are left out, then plain least squares. The covariance is the inverse of JᵀJ, residuals in deviations.
Where nobody says how well shadows were measured, their deviation is estimated from what they leave (variance
components: Förstner, Photogramm Eng Remote Sens 46 (1980) 1).

What the paper does (section III-B): femur and device, each by itself, from the beads in the image of the AP view alone.
With one view this does the same. Several views, the beads' own deviations, and the covariance go beyond it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.beads.model import MINIMUM, Beads
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, Poses, about_point, exp_se3, project_points, transform_points
from femoreg_torch.geometry.rigid import skew

Array = NDArray[np.float64]

_FIRST_PX = 0.5  # deviation of a shadow before it is estimated
_LEAST_PX = 0.02  # what an estimate of it is at least: exact input would make it 0
_OUTSIDE = 5.0  # deviations at which a shadow is left out
_HUBER = 1.5  # deviations
_ROUNDS = 6  # of leaving out and estimating
_SETTLED = 0.02  # relative change of the estimate
_STEPS = 60  # of Levenberg–Marquardt
_STILL = 1e-10  # share of the cost below which a step gains nothing
_DAMPING = (1e-4, 1e8)  # first, and the one at which no step is found


@dataclass(frozen=True)
class Sight:
    """A bead's shadow in one image."""

    object: str
    bead: int
    view: int  # from 0
    image: str  # its file, for the reader
    pixel: tuple[float, float]  # column, row
    spread: float = 1.0  # its deviation, in those of a shadow that nothing disturbs
    kind: str | None = None  # of the image: files of two kinds may have one name, each in a folder of its own


@dataclass(frozen=True, eq=False)
class Bundle:
    """Poses from beads, and their covariance."""

    poses: Poses  # camera 1 is the frame of all
    sights: tuple[Sight, ...]  # that were given
    used: NDArray[np.bool_]  # (S,) those that are not outliers
    residuals_px: Array  # (S, 2) drawn minus seen, of all
    deviation_px: float  # of a shadow of spread 1 along each axis
    estimated: bool  # whether from the residuals
    redundancy: float  # of the used shadows: how many numbers more than needed
    objects: tuple[str, ...]  # in the order of the covariance
    centres: Tensor  # (K, 3) what the twists turn about, in camera 1, mm: of every object, then of every further view
    covariance: Tensor  # (6K, 6K) of twists (rad, mm) along the axes of camera 1 and of each further camera

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the used shadows from where the beads are drawn."""
        return float(np.sqrt((self.residuals_px[self.used] ** 2).sum(1).mean()))


def bundle(
    beads: Sequence[Beads],
    sights: Sequence[Sight],
    start: Poses,
    camera: Camera,
    deviation_px: float | None = None,
) -> Bundle:
    """The most probable poses of all objects and views, from shadows whose beads are known.

    `start` has a pose of every object and of every view that is seen; of its views none may be without a shadow.
    `deviation_px` is that of a shadow of spread 1 along each axis; None: estimated. Raises `InputError` if an object
    or a view is left with too few shadows.
    """
    state = _State(start, torch.zeros(sum(len(thing) for thing in beads), 3, dtype=torch.float64))
    problem = _Problem(beads, sights, camera, len(start.camera_from_camera1))
    used = np.ones(len(sights), bool)
    sigma = _FIRST_PX if deviation_px is None else deviation_px
    for _ in range(_ROUNDS):
        problem.check(used)
        state, fit = problem.solved(state, used, sigma, robust=True)
        before, old = used, sigma
        if deviation_px is None:
            sigma = _robust(problem.even_px(state)[used], fit, sigma)
        used = np.linalg.norm(problem.even_px(state), axis=1) <= _OUTSIDE * sigma * np.sqrt(2)
        if (used == before).all() and abs(sigma / old - 1) < _SETTLED:
            break
    problem.check(used)
    state, fit = problem.solved(state, used, sigma)
    for _ in range(_ROUNDS if deviation_px is None else 0):
        old, sigma = sigma, _estimated(problem.even_px(state)[used], fit, sigma)
        state, fit = problem.solved(state, used, sigma)
        if abs(sigma / old - 1) < _SETTLED:
            break
    centres = problem.centres(state)
    count = 6 * len(centres)
    covariance = np.linalg.pinv(fit.T @ fit, hermitian=True)[:count, :count]
    return Bundle(
        state.poses,
        tuple(sights),
        used,
        problem.residuals_px(state),
        sigma,
        deviation_px is None,
        _redundancy(fit, int(used.sum())),
        tuple(thing.object for thing in beads),
        centres,
        torch.from_numpy(covariance),
    )


def _redundancy(jacobian: Array, sights: int) -> float:
    """How many of the shadows' numbers the unknowns do not take up: Σ (1 − h) over their rows, which come first."""
    q, _ = np.linalg.qr(jacobian)
    return float(2 * sights - (q[: 2 * sights] ** 2).sum())


def _estimated(residuals_px: Array, jacobian: Array, sigma: float) -> float:
    """Deviation of a shadow from its residuals and their redundancy; as it was where there is none to tell by."""
    redundancy = _redundancy(jacobian, len(residuals_px))
    return max(_LEAST_PX, float(np.sqrt((residuals_px**2).sum() / redundancy))) if redundancy > 1 else sigma


def _robust(residuals_px: Array, jacobian: Array, sigma: float) -> float:
    """The same from the median absolute residual, which outliers hardly move."""
    redundancy = _redundancy(jacobian, len(residuals_px))
    if redundancy <= 1:
        return sigma
    share = redundancy / residuals_px.size
    return max(_LEAST_PX, float(1.4826 * np.median(np.abs(residuals_px)) / np.sqrt(share)))


def _by_twist(arms: Tensor) -> Tensor:
    """Derivatives (S, 3, 6) of places by a twist (rad, mm) about a centre; `arms` (S, 3) from there."""
    return torch.cat([-skew(arms), torch.eye(3, dtype=torch.float64).expand(len(arms), 3, 3)], 2)


@dataclass(frozen=True, eq=False)
class _State:
    """Where everything is taken to be."""

    poses: Poses
    shifts: Tensor  # (N, 3) of all beads, mm in their objects


@dataclass(frozen=True, eq=False)
class _Problem:
    """The unknowns of a bundle: twists of objects and of further views, then shifts of beads with a deviation."""

    beads: Sequence[Beads]
    sights: Sequence[Sight]
    camera: Camera
    views: int

    @cached_property
    def names(self) -> list[str]:
        """The objects."""
        return [thing.object for thing in self.beads]

    @cached_property
    def object_of(self) -> NDArray[np.int64]:
        """The object (S,) of every sight."""
        return np.array([self.names.index(sight.object) for sight in self.sights])

    @cached_property
    def view_of(self) -> NDArray[np.int64]:
        """The view (S,) of every sight."""
        return np.array([sight.view for sight in self.sights])

    @cached_property
    def bead_of(self) -> NDArray[np.int64]:
        """Among all beads, that (S,) of every sight."""
        first = np.cumsum([0, *(len(thing) for thing in self.beads)])
        return first[self.object_of] + np.array([sight.bead for sight in self.sights])

    @cached_property
    def points(self) -> Tensor:
        """Of all beads (N, 3), mm in their objects."""
        return torch.cat([thing.points for thing in self.beads])

    @cached_property
    def seen(self) -> Tensor:
        """Pixels (S, 2)."""
        return torch.tensor([sight.pixel for sight in self.sights], dtype=torch.float64)

    @cached_property
    def deviations_mm(self) -> Array:
        """Of the place of each bead (N,)."""
        return torch.cat([thing.deviations_mm for thing in self.beads]).double().numpy()

    @cached_property
    def spreads(self) -> Array:
        """Of every sight (S, 1)."""
        return np.array([[sight.spread] for sight in self.sights])

    def check(self, used: NDArray[np.bool_]) -> None:
        """Raises `InputError` if an object or a view has too few shadows left."""
        for number, name in enumerate(self.names):
            left = len(set(self.bead_of[used & (self.object_of == number)]))
            if left < MINIMUM:
                raise InputError(
                    f"beads of {name}: {left} agree with one pose, at least {MINIMUM} must. Check which shadow is "
                    "which bead, and that CT and images are of one state of the object."
                )
        for view in range(self.views):
            if (used & (self.view_of == view)).sum() < MINIMUM:
                raise InputError(
                    f"view {view + 1}: fewer than {MINIMUM} beads agree with those of the other views. Annotate them "
                    "by hand, or use the first view alone (`views: first`)."
                )

    def centres(self, state: _State) -> Tensor:
        """What twists turn about (K, 3): middles of the objects' beads in camera 1, that of all in further cameras."""
        poses = [state.poses.camera1_from[name] for name in self.names]
        middles = [transform_points(p, t.points.mean(0)[None])[0] for p, t in zip(poses, self.beads, strict=True)]
        middle = torch.stack(middles).mean(0)
        return torch.stack([*middles, *transform_points(state.poses.camera_from_camera1[1:], middle[None])[:, 0]])

    def moved(self, state: _State, step: Tensor) -> _State:
        """The state after a step of all unknowns."""
        centres = self.centres(state)
        count = 6 * len(centres)
        moves = about_point(exp_se3(step[:count].reshape(-1, 6)), centres)
        before = state.poses
        objects = {name: moves[n] @ before.camera1_from[name] for n, name in enumerate(self.names)}
        cameras = before.camera_from_camera1.clone()
        cameras[1:] = moves[len(self.names) :] @ cameras[1:]
        shifts = state.shifts.clone()
        shifts[torch.from_numpy(self.deviations_mm > 0)] += step[count:].reshape(-1, 3)
        return _State(replace(before, camera_from_camera1=cameras, camera1_from=objects), shifts)

    def places(self, state: _State) -> tuple[Tensor, Tensor]:
        """The bead (S, 3) of every sight in camera 1, and in its own camera."""
        points = self.points + state.shifts
        poses = torch.stack([state.poses.camera1_from[name] for name in self.names])[self.object_of]
        first = transform_points(poses, points[self.bead_of][:, None])
        own = transform_points(state.poses.camera_from_camera1[self.view_of], first)
        return first[:, 0], own[:, 0]

    def residuals_px(self, state: _State) -> Array:
        """Drawn minus seen (S, 2)."""
        return (project_points(self.camera, self.places(state)[1]) - self.seen).numpy()

    def even_px(self, state: _State) -> Array:
        """The same by each shadow's spread: all have one deviation."""
        return np.asarray(self.residuals_px(state) / self.spreads)

    def jacobian_px(self, state: _State) -> Array:
        """Derivatives (S, 2, unknowns) of the drawn pixels by all unknowns."""
        first, own = self.places(state)
        centres = self.centres(state)
        eye = torch.eye(2, dtype=torch.float64)
        plane = torch.cat([eye.expand(len(own), 2, 2), -own[:, :2, None] / own[:, 2:, None]], 2)
        across = self.camera.matrix()[:2, :2] @ plane / own[:, 2:, None]  # (S, 2, 3), by the place in the own camera
        by_first = across @ state.poses.camera_from_camera1[self.view_of][:, :3, :3]
        objects = len(self.names)
        free = np.flatnonzero(self.deviations_mm > 0)
        jacobian = np.zeros((len(own), 2, 6 * len(centres) + 3 * len(free)))
        rows = np.arange(len(own))

        def put(rows: NDArray[np.int64], first_column: NDArray[np.int64], block: Tensor) -> None:
            columns = first_column[:, None] + np.arange(block.shape[2])
            jacobian[rows[:, None], :, columns] = block.mT.numpy()

        put(rows, 6 * self.object_of, by_first @ _by_twist(first - centres[self.object_of]))
        later = np.flatnonzero(self.view_of)
        number = objects + self.view_of[later] - 1
        put(later, 6 * number, across[later] @ _by_twist(own[later] - centres[number]))
        shifted = np.flatnonzero(self.deviations_mm[self.bead_of] > 0)
        turns = torch.stack([state.poses.camera1_from[name][:3, :3] for name in self.names])[self.object_of[shifted]]
        place = np.searchsorted(free, self.bead_of[shifted])
        put(shifted, 6 * len(centres) + 3 * place, by_first[shifted] @ turns)
        return jacobian

    def solved(
        self, state: _State, used: NDArray[np.bool_], sigma: float, robust: bool = False
    ) -> tuple[_State, Array]:
        """The state of least squares near one, and the derivatives (rows, unknowns) of its residuals in deviations.

        Rows of the used shadows come first, then those of the beads' shifts.
        """
        damping, limit = _DAMPING
        residuals, cost = self._residuals(state, used, sigma, robust)
        jacobian = self._jacobian(state, used, sigma, robust)
        for _ in range(_STEPS):
            normal, slope = jacobian.T @ jacobian, jacobian.T @ residuals
            while damping < limit:
                damped = normal + damping * np.diag(normal.diagonal() + 1e-12)
                after = self.moved(state, -torch.from_numpy(np.linalg.solve(damped, slope)))
                new, new_cost = self._residuals(after, used, sigma, robust)
                if new_cost <= cost:
                    break
                damping *= 10
            else:
                return state, jacobian
            gain = cost - new_cost
            state, residuals, cost, damping = after, new, new_cost, max(damping / 10, 1e-12)
            jacobian = self._jacobian(state, used, sigma, robust)
            if gain <= _STILL * max(cost, 1e-9):
                break
        return state, jacobian

    def _residuals(self, state: _State, used: NDArray[np.bool_], sigma: float, robust: bool) -> tuple[Array, float]:
        """Residuals in deviations, weighted by Huber's rule where asked, and the cost that they stand for."""
        free = self.deviations_mm > 0
        own = (state.shifts.numpy()[free] / self.deviations_mm[free, None]).ravel()
        shadows = self.even_px(state)[used] / sigma
        length = np.linalg.norm(shadows, axis=1, keepdims=True)
        if not np.isfinite(length).all():  # a bead behind the source
            return np.full(shadows.size + own.size, np.inf), np.inf
        weights = self._weights(length) if robust else np.ones_like(length)
        inside = (length <= _HUBER) | (not robust)
        loss = np.where(inside, length**2, 2 * _HUBER * length - _HUBER**2)
        return np.concatenate([(np.sqrt(weights) * shadows).ravel(), own]), float(loss.sum() + (own**2).sum())

    def _jacobian(self, state: _State, used: NDArray[np.bool_], sigma: float, robust: bool) -> Array:
        rows = (self.jacobian_px(state) / self.spreads[..., None])[used] / sigma
        if robust:
            length = np.linalg.norm(self.even_px(state)[used] / sigma, axis=1, keepdims=True)
            rows = rows * np.sqrt(self._weights(length))[..., None]
        deviations = np.repeat(self.deviations_mm[self.deviations_mm > 0], 3)
        own = np.zeros((len(deviations), rows.shape[2]))
        own[:, rows.shape[2] - len(deviations) :] = np.diag(1 / deviations)
        return np.concatenate([rows.reshape(-1, rows.shape[2]), own])

    @staticmethod
    def _weights(length: Array) -> Array:
        """Of residuals so many deviations long, by Huber's rule."""
        return np.minimum(1, _HUBER / np.maximum(length, 1e-12))
