"""The bones of a CT in the images of all views, and what is asked of their shape and of that of the pictures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import LevenbergMarquardt, Profile, profile
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import mean_quadratic, stage_objective
from femoreg_torch.registration.scene import Body, Moving, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc

LEVEL = Level(pixel_mm=3.1, step_mm=2.0)
_SIMILARITY = GradNcc(patch_radius=5)
_SCALE = (math.pi / 180,) * 3 + (1.0,) * 3  # rad and mm: one unit of a motion
_LEAST_VIEWS = 2  # of one view any shape is another pose, nearly
_REFIT = LevenbergMarquardt(max_iterations=4)


@dataclass(frozen=True)
class Amount:
    """How much of something the images ask for, and its standard deviation."""

    value: float
    deviation: float

    @property
    def sureness(self) -> float:
        """The amount by its deviation."""
        return abs(self.value) / self.deviation if self.deviation > 0 else 0.0


def costs_of_bones(
    scene: Scene,
    poses: Poses,
    names: Sequence[str],
    imaging: Imaging,
    besides: Sequence[Moving] = (),
    level: Level = LEVEL,
) -> ImageCosts | None:
    """The costs of all first images that show the anchor, as functions of how bones and C-arms move.

    `names` are the bones that move, the anchor being one of them. What moves `besides` them comes last. None where
    fewer than two views show the anchor, or leave nothing to compare.
    """
    images = scene.first_images(scene.anchor)
    if len(images) < _LEAST_VIEWS:
        return None
    scale = torch.tensor(_SCALE, dtype=torch.float64)
    carms = [view for _, view in images if view] if scene.camera_from_camera1 is None else []
    bodies = (
        *(Body((name,), 0, reference_point_in_view(scene, poses, name, 0), scale) for name in names),
        *(Body((), view, reference_point_in_view(scene, poses, scene.anchor, view), scale) for view in carms),
        *besides,
    )
    try:
        return image_costs(scene, poses, bodies, list(poses.camera1_from), images, level, _SIMILARITY, imaging=imaging)
    except InputError:  # what is saturated leaves nothing to compare
        return None


@dataclass(frozen=True, eq=False)
class Refitted:
    """What was fitted again: what its images cost, and what they say of the amounts that were asked for."""

    cost: float
    asked: Profile

    @property
    def left(self) -> Tensor:
        """By how much (n,) the amounts are still off, by a step of Newton in all of them."""
        return self._by_tile.sum(0)

    @property
    def deviations(self) -> Tensor:
        """Standard deviations (n,) of the amounts, by the sandwich estimator of `registration.evidence.covariance`."""
        return (self._by_tile - self._by_tile.mean(0)).square().sum(0).sqrt()

    @property
    def _by_tile(self) -> Tensor:
        return -self.asked.scores @ torch.linalg.pinv(self.asked.curvature, hermitian=True)


def refitted(
    scene: Scene,
    poses: Poses,
    names: Sequence[str],
    imaging: Imaging,
    shapes: Sequence[Mapping[str, Tensor]] = (),
    bends: Sequence[Mapping[int, Tensor]] = (),
) -> Refitted | None:
    """The bones `names` and all C-arms fitted to the images again, and asked for the amounts of `shapes` or `bends`.

    These are as `ImageCosts.quadratics` takes them, bends on the grid of `LEVEL`. None as by `costs_of_bones`.
    """
    costs = costs_of_bones(scene, poses, names, imaging)
    if costs is None:
        return None
    found = _REFIT.minimise(stage_objective(costs, costs.bodies, None), len(costs.still), 0)
    model = mean_quadratic(costs.quadratics(found.delta, shapes=shapes, bends=bends))
    return Refitted(found.value, profile(model, len(shapes) + len(bends)))
