"""Is what was registered as rigid still rigid? Each object is cut in two, and the images are asked where its ends lie.

A device that was bent since its model was drawn, or a bone that broke since the CT, is registered as a compromise, or
as the larger part of it, and neither one view nor all together ask for another pose. But were the object cut across its
long axis, the images would move its ends apart.

The shaft of a long bone is nearly round. Derivatives do not say that no image tells its turn about its long axis
(`registration.evidence.turns`): what the voxels draw, and a pin that crosses it, turned such an end by 17°. So ends
that seem to lie apart are asked again, without the turns of an end about its long axis that it may go on by for nearly
nothing. A bone whose ends lie apart by such a turn alone is asked without any of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses, log_so3, transform_points
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.evidence.turns import TOLD, long_axis
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import along_ways, image_quadratic, stage_objective
from femoreg_torch.registration.scene import Body, Kind, RigidObject, Scene, moved, shown_by
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVELS = Level(pixel_mm=3.1, step_mm=1.0), Level(pixel_mm=1.55, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_OPTIMISER = LevenbergMarquardt(max_iterations=6, tol_x=0.05, tol_f=1e-4)
_SCALE = (0.03, 0.03, 0.03, 2.0, 2.0, 6.0)  # rad and mm: one unit of a motion
CUTS = 0.33, 0.5, 0.67  # shares of a length that are tried
_TURN_DEG = 20.0  # about its long axis, to both sides: an end that loses next to nothing by that is not turned
_INSIDE = 0.2  # of the greatest attenuation: what counts as the object
_MOST_POINTS = 2_000
_LEAST_DEVIATION = 1e-6  # degrees and mm: a turn that is held has none but by rounding
Turns = Literal["all", "told", "none"]  # of an end about its long axis: which it makes; `told`: those that images tell
_LEAST_POINTS, _LEAST_SHARE = 30, 0.05  # of each end, among those that the images show


@dataclass(frozen=True, eq=False)
class Bend:
    """How the images would move one end of an object beside the other, were it cut."""

    motion: Tensor  # (6,) degrees and mm, about the middle of the cut, along the axes of camera 1
    deviation: Tensor  # (6,)
    apart_mm: float  # by which points of the end that moves less are moved on average, as far as images show them
    apart_deviation_mm: float  # of that
    gain: float  # of mean patch Grad-NCC over the images that show the object, by both ends together

    @property
    def angle_deg(self) -> float:
        """How far the ends are turned against each other."""
        return float(self.motion[:3].norm())

    @property
    def sureness(self) -> float:
        """The motion by its standard deviations: the most certain of its six parts."""
        return float((self.motion.abs() / self.deviation.clamp_min(_LEAST_DEVIATION)).max())


@dataclass(frozen=True, eq=False)
class _Ends:
    """The two ends of an object, as objects, and points (N, 3) of each that the images show, in its own space, mm."""

    objects: tuple[RigidObject, RigidObject]
    points: tuple[Tensor, Tensor]
    middle: Tensor  # (3,) of the cut


@dataclass(frozen=True, eq=False)
class _Cut:
    """An object cut in two, and what images say of where its ends lie."""

    name: str
    names: tuple[str, str]  # of the ends
    ends: _Ends
    whole: tuple[ImageCosts, ...]  # of the object in one piece, by level

    def placed(self, poses: Poses) -> Poses:
        """With both ends where the object lies in one piece."""
        for each in self.names:
            poses = poses.with_object(each, poses.camera1_from[self.name])
        return poses

    def asked(self, poses: Poses, number: int) -> tuple[tuple[Body, ...], ImageCosts]:
        """The ends as bodies, and what images at the level of this number say of their motions."""
        level = _LEVELS[number]
        bodies = tuple(_body(poses, *end) for end in zip(self.names, self.ends.points, strict=True))
        parts = [replace(end, volume=level.volume(end.volume, sharp=end.sharp)) for end in self.ends.objects]
        return bodies, self.whole[number].in_parts(self.name, dict(zip(self.names, parts, strict=True)), poses, bodies)

    def fitted(self, poses: Poses, ways: Tensor) -> "_Fitted":
        """Where the ends fit, from their poses, as far as they go along some ways (12, n)."""
        for number in range(len(_LEVELS)):
            bodies, costs = self.asked(poses, number)
            objective = along_ways(stage_objective(costs, bodies, None), ways)
            delta = ways @ _OPTIMISER.minimise(objective, ways.shape[1], seed=0).delta
            poses = moved(poses, bodies, delta)
        model = image_quadratic(costs, delta)
        inverse = ways @ torch.linalg.pinv(ways.T @ model.hessian @ ways, hermitian=True) @ ways.T
        return _Fitted(poses, bodies, model.value, inverse @ (model.scores.T @ model.scores) @ inverse)

    def ways(self, poses: Poses, turns: Turns) -> Tensor:
        """The motions (12, n) of the ends, with such turns about their long axes."""
        bodies, costs = self.asked(poses, -1)
        if turns == "all":
            return torch.eye(len(costs.still), dtype=torch.float64)
        points = zip(self.names, self.ends.points, strict=True)
        axes = [long_axis(transform_points(poses.camera1_from[name], of)) for name, of in points]
        about = _about(bodies, axes)
        held = about if turns == "none" else about[_loses_little(costs, about)]
        return torch.linalg.svd(held).Vh[len(held) :].T


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Where both ends fit the images."""

    poses: Poses
    bodies: tuple[Body, ...]  # as they were before the last motion
    cost: float
    spread: Tensor  # (12, 12): covariance of the last motion


def images_of(scene: Scene, poses: Poses, name: str, imaging: Imaging) -> tuple[ImageCosts, ...] | None:
    """Costs of an object's motion in the images that show it, at each level, for `bend`; all else stays where it is.

    None where nothing of an image is exposed.
    """
    thing = replace(scene.objects[name], unsure=())
    scene = replace(scene, objects=scene.objects | {name: thing})
    body = _body(poses, name, thing.reference_point[None])
    render, images = list(poses.camera1_from), scene.first_images(name)
    try:
        return tuple(
            image_costs(scene, poses, (body,), render, images, level, _SIMILARITY, imaging=imaging) for level in _LEVELS
        )
    except InputError:  # what is saturated leaves nothing to compare
        return None


def bend(
    scene: Scene, poses: Poses, name: str, share: float, images: tuple[ImageCosts, ...] | None, turns: Turns = "all"
) -> Bend | None:
    """Of an object at its pose, cut at a share of its length as far as it is seen; `images` are those of `images_of`.

    With `turns` of "told", an end does not turn about its long axis where no image tells that turn; of "none", no end
    turns so.

    None where the images show too little of one end, or nothing of them is exposed.
    """
    cut = _cut(scene, poses, name, share, images)
    if cut is None:
        return None
    uncut = cut.placed(poses)
    _, costs = cut.asked(uncut, -1)
    found = cut.fitted(uncut, cut.ways(uncut, "all"))
    if turns != "all":
        found = cut.fitted(uncut, cut.ways(found.poses, turns))

    first, second = (found.poses.camera1_from[each] for each in cut.names)
    one, other = (transform_points(of, cut.ends.middle[None])[0] for of in (first, second))
    turn = log_so3(first[:3, :3] @ second[:3, :3].T) * 180 / torch.pi
    motion = torch.cat([turn, one - other])
    by_delta = torch.cat([_at(one, found.bodies[0]), -_at(other, found.bodies[1])], 1)
    covariance = by_delta @ found.spread @ by_delta.T
    apart, deviation = min(
        _displacement(motion, covariance, transform_points(second, of) - other) for of in cut.ends.points
    )
    gain = float(costs(costs.still[None]).mean()) - found.cost
    return Bend(motion, covariance.diagonal().clamp_min(0).sqrt(), apart, deviation, gain)


def gain_as_one(scene: Scene, poses: Poses, name: str, share: float, images: tuple[ImageCosts, ...] | None) -> float:
    """What of the similarity an object gains that moves as one, where `bend` cuts it; nothing where that is None."""
    cut = _cut(scene, poses, name, share, images)
    if cut is None:
        return 0.0
    uncut = cut.placed(poses)
    bodies, costs = cut.asked(uncut, -1)
    at_first = _at(bodies[0].centre, bodies[0])
    as_one = torch.cat(
        [torch.eye(6, dtype=torch.float64), torch.linalg.solve(_at(bodies[0].centre, bodies[1]), at_first)]
    )
    return float(costs(costs.still[None]).mean()) - cut.fitted(uncut, as_one).cost


def _cut(scene: Scene, poses: Poses, name: str, share: float, images: tuple[ImageCosts, ...] | None) -> _Cut | None:
    ends = _ends(scene, poses, name, share, scene.first_images(name))
    if ends is None or images is None:
        return None
    return _Cut(name, (f"{name}, one end", f"{name}, the other"), ends, images)


def _about(bodies: Sequence[Body], axes: Sequence[Tensor]) -> Tensor:
    """Turns (2, 12) of two ends, each about its own one of `axes` (3,), by one radian."""
    turns = torch.zeros(len(bodies), 6 * len(bodies), dtype=torch.float64)
    for n, (body, axis) in enumerate(zip(bodies, axes, strict=True)):
        turns[n, 6 * n : 6 * n + 3] = axis / body.scale[:3]
    return turns


def _loses_little(costs: ImageCosts, about: Tensor) -> list[bool]:
    """Whether an end may go on by each of the turns `about` (2, 12) for nearly nothing."""
    far = math.radians(_TURN_DEG) * about
    still, *turned = costs(torch.cat([costs.still[None], far, -far])).mean(1).tolist()
    return [min(pair) - still < TOLD for pair in zip(turned[: len(about)], turned[len(about) :], strict=True)]


def _displacement(motion: Tensor, covariance: Tensor, arms: Tensor) -> tuple[float, float]:
    """Mean displacement by a motion (6,), degrees and mm, of points (N, 3) beside its centre; and its deviation, mm."""
    rates = torch.cat([-skew(arms) * torch.pi / 180, torch.eye(3).expand(len(arms), 3, 3)], 2)  # (N, 3, 6)
    spread = (rates @ covariance @ rates.mT).diagonal(dim1=1, dim2=2).sum(1).mean()
    return float((rates @ motion).norm(dim=1).mean()), float(spread.sqrt())


def _body(poses: Poses, name: str, points: Tensor) -> Body:
    pose = poses.camera1_from[name]
    return Body((name,), 0, transform_points(pose, points.mean(0)[None])[0], torch.tensor(_SCALE, dtype=torch.float64))


def _at(point: Tensor, body: Body) -> Tensor:
    """Motion (6, 6) at a point (3,) in camera 1, degrees and mm, by the deltas of a body."""
    response = torch.eye(6, dtype=torch.float64)
    response[3:, :3] = -skew(point - body.centre) * torch.pi / 180  # ω × arm
    return response * body.scale * torch.tensor([180 / torch.pi] * 3 + [1.0] * 3, dtype=torch.float64)


def _ends(scene: Scene, poses: Poses, name: str, share: float, images: Sequence[tuple[Kind, int]]) -> _Ends | None:
    thing = scene.objects[name]
    volume, data = thing.volume, thing.volume.data
    points = volume.points_above(_INSIDE * float(data.max()), _MOST_POINTS)
    times = torch.stack([shown_by(scene, poses, name, image, points) for image in images]).sum(0)
    points = points[times >= min(2, len(images))]
    least = max(_LEAST_POINTS, round(_LEAST_SHARE * len(points)))
    if len(points) < 2 * least:
        return None
    away = points - points.mean(0)
    axis = torch.linalg.eigh(away.T @ away).eigenvectors[:, -1]
    along = points @ axis
    place = along.min() + share * (along.max() - along.min())
    below = along < place
    if not least <= int(below.sum()) <= len(points) - least:
        return None
    both = points[below], points[~below]
    lower = _heights(volume, axis).to(data.device) < place
    parts = torch.where(lower, data, 0.0), torch.where(lower, 0.0, data)
    one, other = (
        RigidObject(volume.with_data(part), of.mean(0), thing.shown_in, sharp=thing.sharp, hardening=thing.hardening)
        for part, of in zip(parts, both, strict=True)
    )
    near = (along - place).abs().argsort()[:least]
    return _Ends((one, other), both, points[near].mean(0))


def _heights(volume: Volume, axis: Tensor) -> Tensor:
    """Heights (D, H, W) of the voxels along an axis (3,), mm."""
    rates, (depth, height, width) = volume.lps_from_index[:3, :3].T @ axis, volume.data.shape
    x, y, z = (torch.arange(n) * rate for n, rate in zip((width, height, depth), rates, strict=True))
    return z[:, None, None] + y[:, None] + x + volume.lps_from_index[:3, 3] @ axis
