"""Is a device as large as its model? The images are asked whether they fit it better, scaled.

A model that is too large is placed nearer to the detector, where its image is as large as the device's. But views from
several sides do not agree on such a place. They do not either where the voxel size of the CT is wrong, as the C-arm's
poses follow the bones. One view alone tells no size.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import LevenbergMarquardt, Result, parabola_minimum, profile
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.evidence.bones import Amount, Refitted
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import mean_quadratic, stage_objective
from femoreg_torch.registration.scene import Body, Kind, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVEL = Level(pixel_mm=1.55, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_OPTIMISER = LevenbergMarquardt(max_iterations=8, tol_x=0.05, tol_f=1e-5)
_SCALE = (0.03, 0.03, 0.03, 2.0, 2.0, 6.0)  # rad and mm: one unit of a motion
_STEP = 0.02  # sizes that are tried: less, equal, more
_LEAST_VIEWS = 2  # of one view any size is another depth
FURTHEST = 0.04  # from 1, that a parabola through them is believed


@dataclass(frozen=True)
class Size:
    """How large the images show a device."""

    factor: float  # by its model, at most `FURTHEST` off
    gain: float  # of mean patch Grad-NCC, by the best size that was tried
    step: Amount  # by which a step of Newton would enlarge the model, 0.01 for 1 %; 0 where no size gains


def device_size(scene: Scene, poses: Poses, name: str, kind: Kind, imaging: Imaging) -> Size | None:
    """How large the images of a kind show a device, its pose fitted to each size; all else stays where it is.

    Where a thin needle or saturated air leaves the size open, a parabola through the sizes says anything. So the step
    of Newton says how sure that is, the darkness of the device being refitted, by the sandwich estimator over tiles
    (`registration.evidence.covariance`). None of one view, and where an image
    leaves nothing to compare, as where it is all saturated.
    """
    images = scene.there([kind], range(scene.views))
    if len(images) < _LEAST_VIEWS:
        return None
    thing = scene.objects[name]
    body = Body((name,), 0, reference_point_in_view(scene, poses, name, 0), torch.tensor(_SCALE, dtype=torch.float64))
    shown = scene.shown(poses.camera1_from, kind)
    try:
        costs = image_costs(scene, poses, (body,), shown, images, _LEVEL, _SIMILARITY, imaging=imaging)
    except InputError:
        return None
    drawn = costs.objects[name]

    def fitted(factor: float) -> Result:
        scaled = replace(drawn, volume=_scaled(drawn.volume, factor, thing.reference_point))
        objective = stage_objective(costs.with_object(name, scaled), (body,), None)
        return _OPTIMISER.minimise(objective, len(costs.still), seed=0)

    tried = on_all_cores(fitted, [1 - _STEP, 1.0, 1 + _STEP], scene.device)
    less, equal, more = (found.value for found in tried)
    gain = equal - min(less, equal, more)
    step = _step(costs, tried[1].delta, name, thing.reference_point) if gain > 0 else Amount(0.0, math.inf)
    return Size(1 + _best(less, equal, more), gain, step)


def _best(less: float, equal: float, more: float) -> float:
    """By how much larger a model costs least, of what it costs smaller, equal and larger by a step; at most `FURTHEST`.

    Where no parabola has its minimum there, as for a device that is far smaller or larger, it is as far as that on the
    better side.
    """
    steps = parabola_minimum(less, equal, more)
    if math.isnan(steps):
        steps = math.copysign(math.inf, less - more) if min(less, more) < equal else 0.0
    return min(max(_STEP * steps, -FURTHEST), FURTHEST)


def _step(costs: ImageCosts, delta: Tensor, name: str, centre: Tensor) -> Amount:
    """The step of Newton of an object's size about a point (3,) mm, its pose and its darkness being refitted."""
    rate = torch.zeros(4, 4, dtype=torch.float64)
    rate[:3, :3], rate[:3, 3] = torch.eye(3), -centre
    darkness = [(name, costs.objects[name].volume)]
    model = mean_quadratic(costs.quadratics(delta, darkness, shapes=[{name: rate}]))
    asked = Refitted(model.value, profile(model, 1))
    return Amount(float(asked.left), float(asked.deviations))


def _scaled(volume: Volume, factor: float, centre: Tensor) -> Volume:
    """A volume that is larger by a factor about a point (3,) mm, and casts as dark a shadow."""
    larger = torch.eye(4, dtype=torch.float64)
    larger[:3, :3] *= factor
    larger[:3, 3] = (1 - factor) * centre
    return Volume(volume.data / factor, larger @ volume.lps_from_index)
