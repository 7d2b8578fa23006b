"""A device that seems to lie elsewhere in one view is fitted in that image by itself, all else staying where it is.

A step of Newton says how far it would move, and what that would gain, as `registration.evidence.motion` has it. Where
the image hardly bends the cost, it says too much. Fitted, the device tells what moving it really gains. It is not moved
along the beam of its view: nearer or farther it is drawn a little larger or smaller, which also makes up for a material
that is not quite right, and a device that really moved so looks moved aside in other views.
"""

import math

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.evidence.motion import MotionBetween
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import along_ways, stage_objective
from femoreg_torch.registration.scene import Body, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=1.55, step_mm=0.5)
_SIMILARITY = GradNcc(patch_radius=5)
_FIT = LevenbergMarquardt(max_iterations=12)
_SCALE = (math.pi / 180,) * 3 + (1.0,) * 3  # rad and mm: one unit of a motion


def gain_alone(scene: Scene, poses: Poses, drift: MotionBetween, imaging: Imaging) -> float:
    """Share of the cost of a drift's image, of one kind and view, that fitting its objects there alone saves.

    They turn, and move across the beam of that view.
    """
    assert drift.kind is not None
    name, view = drift.objects[0], drift.views[0]
    scale = torch.tensor(_SCALE, dtype=torch.float64)
    body = Body(drift.objects, 0, reference_point_in_view(scene, poses, name, 0), scale)
    images = [(drift.kind, view)]
    costs = image_costs(scene, poses, (body,), list(poses.camera1_from), images, _LEVEL, _SIMILARITY, imaging=imaging)
    before = float(costs(costs.still[None]).mean())
    across = _across_the_beam(reference_point_in_view(scene, poses, name, view), poses.camera_from_camera1[view])
    objective = along_ways(stage_objective(costs, costs.bodies, None), across)
    found = _FIT.minimise(objective, across.shape[1], 0)
    return (before - found.value) / before


def _across_the_beam(point: Tensor, camera_from_camera1: Tensor) -> Tensor:
    """Motions (6, 5) of a body in camera 1 that do not bring its `point` (3,), in a view's camera, along its beam."""
    beam = camera_from_camera1[:3, :3].T @ (point / point.norm())
    along = torch.cat([torch.zeros(3, dtype=torch.float64), beam])
    return torch.linalg.svd(along[None]).Vh[1:].T
