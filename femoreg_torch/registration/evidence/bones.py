"""The bones of a CT in the images of all views, and what is asked of their shape and of that of the pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Body, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.1, step_mm=2.0)
_SIMILARITY = GradNcc(patch_radius=5)
_SCALE = (math.pi / 180,) * 3 + (1.0,) * 3  # rad and mm: one unit of a motion
_LEAST_VIEWS = 2  # of one view any shape is another pose, nearly


@dataclass(frozen=True)
class Amount:
    """How much of something the images ask for, and its standard deviation."""

    value: float
    deviation: float

    @property
    def sureness(self) -> float:
        """The amount by its deviation."""
        return abs(self.value) / self.deviation if self.deviation > 0 else 0.0


def costs_of_bones(scene: Scene, poses: Poses, names: Sequence[str], imaging: Imaging) -> ImageCosts | None:
    """The costs of all first images that show the anchor, as functions of how bones and C-arms move.

    `names` are the bones that move, the anchor being one of them. None where fewer than two views show the anchor, or
    leave nothing to compare.
    """
    images = scene.first_images(scene.anchor)
    if len(images) < _LEAST_VIEWS:
        return None
    scale = torch.tensor(_SCALE, dtype=torch.float64)
    carms = [view for _, view in images if view] if scene.camera_from_camera1 is None else []
    bodies = (
        *(Body((name,), 0, reference_point_in_view(scene, poses, name, 0), scale) for name in names),
        *(Body((), view, reference_point_in_view(scene, poses, scene.anchor, view), scale) for view in carms),
    )
    try:
        return image_costs(scene, poses, bodies, list(poses.camera1_from), images, _LEVEL, _SIMILARITY, imaging=imaging)
    except InputError:  # what is saturated leaves nothing to compare
        return None
