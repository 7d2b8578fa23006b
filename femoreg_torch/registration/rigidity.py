"""Is what was registered as rigid still rigid? Each object is cut in two, and the images are asked where its ends lie.

A device that was bent since its model was drawn, or a bone that broke since the CT, is registered as a compromise, or
as the larger part of it, and neither one view nor all together ask for another pose. But were the object cut across its
long axis, the images would move its ends apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses, log_so3, project_points, transform_points
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import ImageCosts, image_costs, image_quadratic, stage_objective
from femoreg_torch.registration.scene import Body, Kind, RigidObject, Scene, moved
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVELS = Level(pixel_mm=3.1, step_mm=1.0), Level(pixel_mm=1.55, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_OPTIMISER = LevenbergMarquardt(max_iterations=6, tol_x=0.05, tol_f=1e-4)
_SCALE = (0.03, 0.03, 0.03, 2.0, 2.0, 6.0)  # rad and mm: one unit of a motion
CUTS = 0.33, 0.5, 0.67  # shares of a length that are tried
_INSIDE = 0.2  # of the greatest attenuation: what counts as the object
_MOST_POINTS = 2_000
_LEAST_POINTS, _LEAST_SHARE = 30, 0.05  # of each end, among those that the images show


@dataclass(frozen=True, eq=False)
class Bend:
    """How the images would move one end of an object beside the other, were it cut."""

    motion: Tensor  # (6,) degrees and mm, about the middle of the cut, along the axes of camera 1
    deviation: Tensor  # (6,)
    apart_mm: float  # by which points of the end that moves less are moved on average, as far as images show them
    apart_deviation_mm: float
    gain: float  # of similarity, by both ends together

    @property
    def angle_deg(self) -> float:
        """How far the ends are turned against each other."""
        return float(self.motion[:3].norm())

    @property
    def sureness(self) -> float:
        """The motion by its standard deviations: the most certain of its six parts."""
        return float((self.motion.abs() / self.deviation).max())


@dataclass(frozen=True, eq=False)
class _Ends:
    """The two ends of an object, as objects, and points (N, 3) of each that the images show, in its own space, mm."""

    objects: tuple[RigidObject, RigidObject]
    points: tuple[Tensor, Tensor]
    cut: Tensor  # (3,) its middle


def bend(scene: Scene, poses: Poses, name: str, share: float, imaging: Imaging) -> Bend | None:
    """Of an object at its pose, cut at a share of its length as far as it is seen; all else stays where it is.

    None where the images show too little of one end, or nothing of them is exposed.
    """
    images: list[tuple[Kind, int]] = []
    for view in range(scene.views):
        images += scene.there(scene.objects[name].shown_in, (view,))[:1]
    ends = _cut(scene, poses, name, share, images)
    if ends is None:
        return None
    pose, names = poses.camera1_from[name], (f"{name}, one end", f"{name}, the other")
    scene = replace(scene, objects=scene.objects | dict(zip(names, ends.objects, strict=True)))
    shown = [other for other in poses.camera1_from if other != name]
    for each in names:
        poses = poses.with_object(each, pose)

    def asked(level: Level) -> tuple[tuple[Body, ...], ImageCosts]:
        bodies = tuple(_body(poses, *end) for end in zip(names, ends.points, strict=True))
        return bodies, image_costs(scene, poses, bodies, [*shown, *names], images, level, _SIMILARITY, imaging=imaging)

    try:
        for level in _LEVELS:
            bodies, costs = asked(level)
    except InputError:  # what is saturated leaves nothing to compare
        return None
    uncut = float(costs(torch.zeros(1, len(costs.still), dtype=torch.float64)).mean())
    for level in _LEVELS:
        bodies, costs = asked(level)
        found = _OPTIMISER.minimise(stage_objective(costs, bodies, None), len(costs.still), seed=0).delta
        poses = moved(poses, bodies, found)
    model = image_quadratic(costs, found)
    inverse = torch.linalg.pinv(model.hessian, hermitian=True)
    spread = inverse @ (model.scores.T @ model.scores) @ inverse

    first, second = (poses.camera1_from[each] for each in names)
    one, other = (transform_points(of, ends.cut[None])[0] for of in (first, second))
    turn = log_so3(first[:3, :3] @ second[:3, :3].T) * 180 / torch.pi
    motion = torch.cat([turn, one - other])
    by_delta = torch.cat([_at(one, bodies[0]), -_at(other, bodies[1])], 1)
    covariance = by_delta @ spread @ by_delta.T
    apart, deviation = min(
        _displacement(motion, covariance, transform_points(second, of) - other) for of in ends.points
    )
    return Bend(motion, covariance.diagonal().sqrt(), apart, deviation, uncut - model.value)


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


def _cut(scene: Scene, poses: Poses, name: str, share: float, images: Sequence[tuple[Kind, int]]) -> _Ends | None:
    thing = scene.objects[name]
    volume, data = thing.volume, thing.volume.data
    filled = (data > _INSIDE * data.max()).nonzero().cpu()
    points = transform_points(volume.lps_from_index, filled[:: 1 + len(filled) // _MOST_POINTS].flip(1).double())
    times = torch.stack([_seen(scene, poses, name, image, points) for image in images]).sum(0)
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


def _seen(scene: Scene, poses: Poses, name: str, image: tuple[Kind, int], points: Tensor) -> Tensor:
    """Which points (N, 3) of an object lie on the exposed part of the detector in an image."""
    camera, exposed = scene.camera(poses, image[1]), scene.field(*image)
    pixels = project_points(camera, transform_points(poses.camera_from(name)[image[1]], points))
    on_it = ((pixels > 0) & (pixels < pixels.new_tensor(camera.shape).flip(0) - 1)).all(-1)
    if exposed is not None:
        column, row = torch.where(on_it[:, None], pixels, 0).round().long().unbind(1)
        on_it &= exposed.cpu()[row, column]
    return on_it


def _heights(volume: Volume, axis: Tensor) -> Tensor:
    """Heights (D, H, W) of the voxels along an axis (3,), mm."""
    rates, (depth, height, width) = volume.lps_from_index[:3, :3].T @ axis, volume.data.shape
    x, y, z = (torch.arange(n) * rate for n, rate in zip((width, height, depth), rates, strict=True))
    return z[:, None, None] + y[:, None] + x + volume.lps_from_index[:3, 3] @ axis
