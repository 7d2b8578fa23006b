"""A shift of all principal points that the images ask for is tried: do they cost less with it?

A step of Newton tells the shift, but it is nearly a turn of the C-arm, and what is drawn a little wrong asks for one
too. The bones answer it as they would by that step, so the shift is tried along the valley of the cost, where little
else changes.
"""

import math

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import profile
from femoreg_torch.registration.evidence.bones import costs_of_bones
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.intrinsics import POINTS
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import mean_quadratic
from femoreg_torch.registration.scene import Scene, intrinsics_of, moved

_LEVEL = Level(pixel_mm=1.55, step_mm=1.0)


def gain_of_shifted_points(scene: Scene, poses: Poses, shift: Tensor, imaging: Imaging) -> float:
    """Share of the cost of all first images that a `shift` (2,) of the principal points of all views saves.

    In standard deviations of the C-arm's file. Bones that the first images show, and the C-arms of other views, answer
    it. nan where the images leave nothing to compare.
    """
    names = [name for name in poses.camera1_from if scene.first_kind in scene.objects[name].shown_in]
    points = intrinsics_of(scene, poses, names).only({POINTS})
    costs = costs_of_bones(scene, poses, names, imaging, besides=[points], level=_LEVEL)
    if costs is None:
        return math.nan
    model = mean_quadratic(costs.quadratics(costs.still))
    shifts = shift.repeat(scene.views)
    delta = torch.cat([profile(model, len(shifts)).answer @ shifts, shifts])
    there = moved(poses, costs.bodies, delta)
    after = costs_of_bones(scene, there, names, imaging, besides=[points], level=_LEVEL)
    if after is None:
        return math.nan
    return 1 - float(after(after.still[None]).mean()) / model.value
