"""Is a device as large as its model? The images are asked whether they fit it better, scaled.

A model of another size in the series, or in other units, is placed where it fits on the whole: the larger one nearer to
the detector. Between views from several sides that does not work out. Nor does it where the CT's voxel size is wrong,
as the C-arm's poses follow the bones.
"""

from dataclasses import dataclass, replace

import torch

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import image_costs, stage_objective
from femoreg_torch.registration.scene import Body, Kind, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVEL = Level(pixel_mm=1.55, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_OPTIMISER = LevenbergMarquardt(max_iterations=8, tol_x=0.05, tol_f=1e-5)
_SCALE = (0.03, 0.03, 0.03, 2.0, 2.0, 6.0)  # rad and mm: one unit of a motion
_STEP = 0.02  # sizes that are tried: less, equal, more
_FURTHEST = 2.0  # steps that a parabola through them is believed


@dataclass(frozen=True)
class Size:
    """How large the images show a device."""

    factor: float  # by its model
    gain: float  # of mean patch Grad-NCC, by the best size that was tried


def size(scene: Scene, poses: Poses, name: str, kind: Kind, imaging: Imaging) -> Size:
    """Of a device, in the images of a kind, its pose fitted to each size; all else stays where it is."""
    images = scene.there([kind], range(scene.views))
    thing = scene.objects[name]
    body = Body((name,), 0, reference_point_in_view(scene, poses, name, 0), torch.tensor(_SCALE, dtype=torch.float64))
    shown = scene.shown(poses.camera1_from, kind)
    costs = image_costs(scene, poses, (body,), shown, images, _LEVEL, _SIMILARITY, imaging=imaging)
    drawn = costs.objects[name]

    def fitted(factor: float) -> float:
        scaled = replace(drawn, volume=_scaled(drawn.volume, factor, thing.reference_point))
        objective = stage_objective(costs.with_object(name, scaled), (body,), None)
        return _OPTIMISER.minimise(objective, len(costs.still), seed=0).value

    less, equal, more = on_all_cores(fitted, [1 - _STEP, 1.0, 1 + _STEP], scene.device)
    bend = less - 2 * equal + more
    steps = (less - more) / (2 * bend) if bend > 0 else 0.0
    return Size(1 + _STEP * min(max(steps, -_FURTHEST), _FURTHEST), equal - min(less, equal, more))


def _scaled(volume: Volume, factor: float, centre: torch.Tensor) -> Volume:
    """A volume that is larger by a factor about a point (3,) mm, and casts the same shadow per voxel."""
    larger = torch.eye(4, dtype=torch.float64)
    larger[:3, :3] *= factor
    larger[:3, 3] = (1 - factor) * centre
    return Volume(volume.data / factor, larger @ volume.lps_from_index)
