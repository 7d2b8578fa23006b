"""Has the CT the shape of the patient? The images are asked how its bones would have to be stretched and sheared.

A CT whose slices lie farther apart than is told is too short. One whose gantry was tilted, and whose slices were
stacked straight, is sheared, and so is one of a patient who slid while it was taken. Pictures whose pixels are not as
wide and high as is told show a stretched patient. Bones of such a shape do not fit views from several sides, wherever
bones and C-arms lie: all of these are refitted here. A change of size alone looks like another depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import profile
from femoreg_torch.registration.evidence.bones import Amount, costs_of_bones, refitted
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.objective import mean_quadratic
from femoreg_torch.registration.scene import Scene

# stretch: along the slices' normal, 0.01 where they lie 1 % farther apart than the CT says
# tilt, slide: by how much slices are shifted along their columns, or their rows, per distance between them
Way = Literal["stretch", "tilt", "slide"]
_LEAST: dict[Way, float] = {"stretch": 0.005, "tilt": 0.008, "slide": 0.008}  # that is looked at twice
_MOST = 0.2  # images that hardly tell a way ask for any amount of it
# Where rays run along rows of voxels, what is drawn ripples, and costs more than it does from any other direction. So
# what a CT costs as it is told is the mean of two that are deformed by so little to either side.
_ASIDE = 0.003


@dataclass(frozen=True)
class Deformation:
    """How the images would deform the bones of a CT in one way, and by how much less they cost then."""

    way: Way
    amount: Amount  # as a share: 0.01 for 1 %
    gain: float  # share of the costs of all first images that is saved


def ct_shape(scene: Scene, poses: Poses, names: Sequence[str], imaging: Imaging) -> tuple[Deformation, ...]:
    """Every way in which the images would deform the bones `names` of a CT, the anchor among them, by more than little.

    A step of Newton along each way by itself, all poses refitted. Then the bones are deformed by these, the poses
    refitted, and the rest is added. Deviations are those of the sandwich estimator over tiles there, see
    `registration.evidence.covariance`. Nothing where fewer than two views show the anchor.
    """
    costs = costs_of_bones(scene, poses, names, imaging)
    if costs is None:
        return ()
    thing = scene.objects[scene.anchor]
    rates = _rates(thing.volume.lps_from_index, thing.reference_point)
    model = mean_quadratic(
        costs.quadratics(costs.still, shapes=[dict.fromkeys(names, rate) for rate in rates.values()])
    )
    found = profile(model, len(rates))
    steps = -found.scores.sum(0) / found.curvature.diagonal().clamp_min(0)
    likely = [(way, float(step)) for way, step in zip(rates, steps, strict=True) if _LEAST[way] < abs(step) < _MOST]

    def looked_at_twice(each: tuple[Way, float]) -> Deformation | None:
        way, step = each
        rate = rates[way]

        def deformed(amount: float) -> Scene:
            return _deformed(scene, names, amount * rate)

        shapes = [dict.fromkeys(names, rate)]
        after = refitted(deformed(step), poses, names, imaging, shapes)
        before = [refitted(deformed(aside), poses, names, imaging, shapes) for aside in (_ASIDE, -_ASIDE)]
        told = [each.cost for each in before if each is not None]
        if after is None or not told:
            return None
        cost = sum(told) / len(told)
        amount = Amount(step + float(after.left), float(after.deviations))
        return Deformation(way, amount, (cost - after.cost) / cost)

    looked = on_all_cores(looked_at_twice, likely, scene.device)
    return tuple(each for each in looked if each is not None)


def _deformed(scene: Scene, names: Sequence[str], rate: Tensor) -> Scene:
    """The scene with bones deformed by a rate (4, 4)."""
    objects = dict(scene.objects)
    for name in names:
        volume = objects[name].volume
        lps_from_index = (torch.eye(4, dtype=torch.float64) + rate) @ volume.lps_from_index
        objects[name] = replace(objects[name], volume=replace(volume, lps_from_index=lps_from_index))
    return replace(scene, objects=objects)


def _rates(lps_from_index: Tensor, centre: Tensor) -> dict[Way, Tensor]:
    """Rates (4, 4) at which points in LPS move about a point (3,) mm."""
    rows, columns, normal = (lps_from_index[:3, :3] / lps_from_index[:3, :3].norm(dim=0)).T
    ways: dict[Way, Tensor] = {"stretch": normal, "tilt": columns, "slide": rows}
    found = {}
    for way, along in ways.items():
        linear = torch.outer(along, normal)
        rate = torch.zeros(4, 4, dtype=torch.float64)
        rate[:3, :3], rate[:3, 3] = linear, -linear @ centre
        found[way] = rate
    return found
