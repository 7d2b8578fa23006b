"""Has the CT the shape of the patient? The images are asked how its bones would have to be stretched and sheared.

A CT whose slices lie farther apart than is told is too short. One whose gantry was tilted, and whose slices were
stacked straight, is sheared, and so is one of a patient who slid while it was taken. Pictures whose pixels are not as
wide and high as is told show a stretched patient. Bones of such a shape do not fit views from several sides, wherever
bones and C-arms lie: all of these are refitted here. A change of size alone looks like another depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import profile
from femoreg_torch.registration.evidence.bones import Amount, costs_of_bones
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.objective import mean_quadratic
from femoreg_torch.registration.scene import Scene


@dataclass(frozen=True)
class CtShape:
    """How the images would deform the bones of a CT. Each amount is asked by itself, the other two being zero."""

    stretch: Amount  # along the slices' normal: 0.01 where they lie 1 % farther apart than the CT says
    tilt: Amount  # by how much slices are shifted along their columns, per distance between them
    slide: Amount  # the same along their rows


def ct_shape(scene: Scene, poses: Poses, names: Sequence[str], imaging: Imaging) -> CtShape | None:
    """What the images say of the shape of a CT, of which these objects are bones; the anchor is one of them.

    A step of Newton along each way, all poses refitted, with the deviation of the sandwich estimator over tiles; see
    `registration.evidence.covariance`. None where fewer than two views show the anchor, or leave nothing to compare.
    """
    costs = costs_of_bones(scene, poses, names, imaging)
    if costs is None:
        return None
    thing = scene.objects[scene.anchor]
    rates = _rates(thing.volume.lps_from_index, thing.reference_point)
    model = mean_quadratic(costs.quadratics(costs.still, shapes=[dict.fromkeys(names, rate) for rate in rates]))
    found = profile(model, len(rates))
    curvature = found.curvature.diagonal()
    values, deviations = -found.scores.sum(0) / curvature, found.scores.square().sum(0).sqrt() / curvature
    return CtShape(*map(Amount, values.tolist(), deviations.tolist()))


def _rates(lps_from_index: Tensor, centre: Tensor) -> list[Tensor]:
    """Rates (4, 4) of stretch, tilt and slide of slices about a point (3,) mm, by which points in LPS move."""
    rows, columns, normal = (lps_from_index[:3, :3] / lps_from_index[:3, :3].norm(dim=0)).T
    found = []
    for way in (normal, columns, rows):
        linear = torch.outer(way, normal)
        rate = torch.zeros(4, 4, dtype=torch.float64)
        rate[:3, :3], rate[:3, 3] = linear, -linear @ centre
        found.append(rate)
    return found
