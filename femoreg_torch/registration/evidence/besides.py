"""What images with a device show besides it: cement, a hand, or another wire, which it may have been taken for.

Images without and with a device, from one C-arm pose, differ in what came between them: in the logarithm of intensity
by the shadow of the device, and by nothing elsewhere. Where they differ there, something else came or went. Scattered
light differs too, as the device takes some away, and the more so the less light goes straight through the patient. But
a shadow has an edge, and scattered light has none.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import natural
from femoreg_torch.geometry import Camera, Poses, transform_points
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.compared import exposed_in_both
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging, draw
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, Kind, Scene, moved, reference_point_in_view
from femoreg_torch.registration.weights import dilated
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.1, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_SHADOW = 0.15  # of the logarithm of intensity: what is seen of 0.15 mm of steel or 8 mm of water
_LEAST_STEP = 0.5  # of that: by how much a shadow is stronger within its edge than beyond it
_AROUND_MM = 6.0  # on the detector, beside what is drawn: of a pose or model that is a little wrong; and of an edge
_LEAST_SHARE, _LEAST_MM2 = 0.2, 150.0  # of the device's own shadow, and on the detector
_SMOOTH_MM, _MOST_BRIGHTER = 15.0, 1.0  # on the detector, standard deviation; of the logarithm of intensity
_NEARLY_ALL = 0.1  # quantile of a change that is alike all over
_INSIDE = 0.2  # of the greatest attenuation: what counts as the device
_MOST_POINTS = 5_000
_NEAREST_MM, _FARTHEST_MM, _STEP_MM = 4.0, 24.0, 2.0  # along both axes across the device: where another is looked for
_STARTS = 5
_ALONG_THE_BEAM = 0.95  # cosine: of a device that lies so, another axis of camera 1 stands for the beam
# Stopped after 15 iterations, one on its way back to the device was 4 mm beside it, and told as a rival.
_OPTIMISER = LevenbergMarquardt(max_iterations=30, tol_x=0.02, tol_f=1e-5)
_SCALE = (0.03, 0.03, 0.03, 1.0, 1.0, 3.0)  # rad and mm: one unit of a motion
_APART_MM = 3.0  # what lies nearer, or nearer than the device is wide (root mean square), is the device itself


@dataclass(frozen=True)
class Besides:
    """What the images of one view show besides a device: mm² on the detector."""

    view: int  # from 0
    device_mm2: float  # of the device's own shadow
    more_mm2: float  # darker with the device than without it
    less_mm2: float  # brighter

    @property
    def more(self) -> bool:
        """Whether something came with the device."""
        return self.more_mm2 > max(_LEAST_SHARE * self.device_mm2, _LEAST_MM2)

    @property
    def less(self) -> bool:
        """Whether something went when the device came."""
        return self.less_mm2 > max(_LEAST_SHARE * self.device_mm2, _LEAST_MM2)


@dataclass(frozen=True)
class Rival:
    """Another place where a device fits the images with it."""

    apart_mm: float  # across the long axis of the device, in camera 1
    # of the similarity that the device adds where it was found, without the view that gains most at the other place;
    # above 1 where it fits better there
    share: float


def besides(scene: Scene, poses: Poses, name: str, kind: Kind) -> list[Besides]:
    """What images of a `kind` show besides a device that those of the first kind lack, or the other way round.

    Views without one of the images, or without natural logarithms in both, are left out.
    """
    return [
        found for _, view in scene.there([kind], range(scene.views)) if (found := _look(scene, poses, name, kind, view))
    ]


@dataclass(frozen=True)
class _Change:
    """How an image with a device differs from that without it, on pixels of `_LEVEL`."""

    camera: Camera
    change: Tensor  # (H, W), of the logarithm of intensity: darker with the device than without it
    own: Tensor  # (H, W), bool: exposed pixels that the device is drawn on
    elsewhere: Tensor  # (H, W), bool: exposed pixels that it is not near


def _change(scene: Scene, poses: Poses, name: str, kind: Kind, view: int) -> _Change:
    camera = poses.camera(view, _LEVEL.camera(scene.carm.camera))
    without, with_it = (_LEVEL.image(scene.image(each, view), scene.carm.camera) for each in (scene.first_kind, kind))
    exposed = exposed_in_both(scene, (scene.first_kind, kind), view, _LEVEL)
    drawn = draw([scene.objects[name]], poses.camera_from(name)[view][None, None], camera, _LEVEL.step_mm)[0] > 0
    return _Change(camera, with_it - without, drawn & exposed, exposed & ~dilated(drawn, _AROUND_MM, camera))


def change_about(scene: Scene, poses: Poses, name: str, kind: Kind, view: int) -> Tensor:
    """How much darker (H, W) the image with a device is than the one without it about its shadow, negative if brighter.

    Of the logarithm of intensity. An exposure counts that makes nearly the whole image darker, not what came beside the
    device. Where the image is brighter about the device, that is smoothed over some centimetres, and continued into the
    shadow.
    """
    image, seen = scene.image(kind, view), _change(scene, poses, name, kind, view)
    if not seen.elsewhere.any():
        return torch.zeros_like(image)
    counts = seen.elsewhere.cpu().double().numpy()
    exposure = max(0.0, float(seen.change[seen.elsewhere].double().quantile(_NEARLY_ALL)))
    change = ((seen.change - exposure).cpu().double().numpy() * counts).clip(-_MOST_BRIGHTER, _MOST_BRIGHTER)
    width = _SMOOTH_MM / np.array(seen.camera.pixel_mm)
    summed, weight = (ndimage.gaussian_filter(each, width, mode="constant") for each in (change, counts))
    smooth = torch.from_numpy(exposure + (summed / weight.clip(1e-6)).clip(None, 0)).to(image)
    return F.interpolate(smooth[None, None], tuple(image.shape), mode="bilinear")[0, 0]


def _look(scene: Scene, poses: Poses, name: str, kind: Kind, view: int) -> Besides | None:
    if not scene.there([scene.first_kind], (view,)):
        return None
    if not all(natural(scene.image(each, view)) for each in (scene.first_kind, kind)):
        return None
    seen = _change(scene, poses, name, kind, view)
    if not seen.elsewhere.any():
        return None
    change = seen.change - seen.change[seen.elsewhere].median()  # exposures differ
    mm2 = math.prod(seen.camera.pixel_mm)
    beside = (_shadows(way, seen.elsewhere, seen.camera) for way in (change, -change))
    areas = (seen.own & (change > _SHADOW), *beside)
    return Besides(view, *(mm2 * int(area.count_nonzero()) for area in areas))


def _shadows(change: Tensor, where: Tensor, camera: Camera) -> Tensor:
    """Pixels (H, W) of a change that are shadows: of those that hang together, the change ends with a step."""
    values, asked = change.cpu().double().numpy(), where.cpu().numpy()
    inside = asked & (values > _SHADOW)
    parts, count = ndimage.label(inside)
    away, nearest = ndimage.distance_transform_edt(~inside, sampling=camera.pixel_mm, return_indices=True)
    rim = inside & (ndimage.distance_transform_edt(inside, sampling=camera.pixel_mm) <= _AROUND_MM)
    around = np.where(asked & ~inside & (away <= _AROUND_MM), parts[tuple(nearest)], 0)
    has_step = np.zeros(count + 1, dtype=bool)
    for part in range(1, count + 1):
        beside = values[around == part]
        has_step[part] = not len(beside) or values[rim & (parts == part)].mean() - beside.mean() > _LEAST_STEP * _SHADOW
    return torch.from_numpy(has_step[parts])


def rival(scene: Scene, poses: Poses, name: str, kind: Kind, imaging: Imaging) -> Rival | None:
    """The best other place of a device, up to 24 mm along both axes across it, by images of a `kind`; all else stays.

    Of several views the one that gains most there is left out: along its beam the device moves nearly unseen, and lies
    over itself. None where none of the best few starts ends elsewhere, or nothing is exposed.
    """
    thing, pose = scene.objects[name], poses.camera1_from[name]
    filled = thing.volume.points_above(_INSIDE * float(thing.volume.data.max()), _MOST_POINTS)
    points = transform_points(pose, filled)
    away = points - points.mean(0)
    moments, axes = torch.linalg.eigh(away.T @ away / len(points))  # the last is long
    apart, across = max(_APART_MM, math.sqrt(moments[1])), _across(axes[:, 2])
    centre, scale = reference_point_in_view(scene, poses, name, 0), torch.tensor(_SCALE, dtype=torch.float64)
    body = Body((name,), 0, centre, scale)
    images = scene.there([kind], range(scene.views))
    names = tuple(poses.camera1_from)
    try:
        costs = image_costs(scene, poses, (body,), names, images, _LEVEL, _SIMILARITY, imaging=imaging)
    except InputError:  # what is saturated leaves nothing to compare
        return None
    without = costs.without_what_moves()
    gains = without - costs(costs.still[None])[0]
    found: list[Rival] = []
    for place in _lowest(lambda deltas: costs(deltas).mean(1), across, scale):
        start = torch.zeros(6, dtype=torch.float64)
        start[3:] = across @ place / scale[3:]
        begun = moved(poses, (body,), start)
        again = Body((name,), 0, reference_point_in_view(scene, begun, name, 0), scale)
        there = image_costs(scene, begun, (again,), names, images, _LEVEL, _SIMILARITY, imaging=imaging)
        result = _OPTIMISER.minimise(stage_objective(there, (again,), None), 6, seed=0)
        ended = moved(begun, (again,), result.delta).camera1_from[name]
        moved_by = transform_points(ended, filled).mean(0) - points.mean(0)
        beside = float((moved_by @ across).norm())
        if beside > apart:
            found.append(Rival(beside, _share(without - there(result.delta[None])[0], gains)))
    return max(found, key=lambda each: each.share, default=None)


def _across(long: Tensor) -> Tensor:
    """Two directions (3, 2) across a device, by where its long axis (3,) lies in camera 1: the first across the beam.

    The device's own axes are no help: those across a square or a round one are any, by rounding.
    """
    beam = torch.tensor([0.0, 0.0, 1.0] if abs(long[2]) < _ALONG_THE_BEAM else [1.0, 0.0, 0.0], dtype=torch.float64)
    first = torch.linalg.cross(long, beam)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(long, first)], 1)


def _share(elsewhere: Tensor, here: Tensor) -> float:
    """What a device gains elsewhere of what it gains here (images,), without the image that it gains most in."""
    asked = torch.ones_like(elsewhere, dtype=torch.bool)
    if len(elsewhere) > 1:
        asked[elsewhere.argmax()] = False
    least = float(here[asked].sum())
    return float(elsewhere[asked].sum()) / least if least > 0 else 0.0


def _lowest(cost: Callable[[Tensor], Tensor], across: Tensor, scale: Tensor) -> list[Tensor]:
    """The best few places (2,), mm along two axes `across` (3, 2), that fit better than all around them.

    Where views look nearly alike, similarity falls slowly along the depth; places on that slope lead back.
    """
    steps = torch.arange(-_FARTHEST_MM, _FARTHEST_MM + _STEP_MM, _STEP_MM, dtype=torch.float64)
    places = torch.cartesian_prod(steps, steps)
    deltas = torch.zeros(len(places), 6, dtype=torch.float64)
    deltas[:, 3:] = places @ across.T / scale[3:]
    costs = cost(deltas).view(1, len(steps), len(steps))
    lowest = (costs <= -F.max_pool2d(-costs, 3, 1, 1)).flatten() & (places.norm(dim=1) >= _NEAREST_MM)
    order = costs.flatten().masked_fill(~lowest, math.inf).argsort()
    return list(places[order[: min(_STARTS, int(lowest.count_nonzero()))]])
