"""Exhaustive search of the other views along the C-arm's orbit, then of turned, tilted and rolled C-arms."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.cores import on_all_cores
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses, about_point, exp_so3, orbit_angles, rigid, transform_points
from femoreg_torch.registration.compared import exposed_field, prepared
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Kind, Scene
from femoreg_torch.registration.step import (
    CARM_IS_KNOWN,
    ONE_VIEW,
    check_known,
    chosen_kinds,
    chosen_objects,
    lacking,
    one_after_another,
)
from femoreg_torch.settings import check_within
from femoreg_torch.similarity import Similarity, even_gradients, shift_correlation

# Angles that are looked at with the similarity itself. In 16 views of eight cases, 1.1 to 1.4 degrees and up to 24 mm
# off the orbit, the best of all was among the first four.
_MOST_SHIFTED = 12
_FURTHER_SHIFT = 2.0  # times `shift_mm`, away from the range of the orbit
# Further away C-arms are turned and tilted in coarse steps and compared at a coarser level, and the best one is then
# looked for about what was found. In twelve views of six cases of two simulators the search along the orbit came within
# 2 to 31° (views were tilted towards head or feet by up to 20°), and this one within 1.0 to 3.7°.
_TURN_STEP_DEG, _TILT_STEP_DEG, _MOST_TILT_DEG = 4.0, 8.0, 32.0
_MOST_TURN_OF_TILTED_DEG = 60.0
# A C-arm that swings, or whose base is turned between the views, turns its image. A view 7° from view 1, rolled by 8°,
# was not found without a roll, and one 30° from it, rolled by 15°, not with rolls of 8°.
_ROLLS_DEG, _MOST_TURN_OF_ROLLED_DEG = (-16.0, -8.0, 8.0, 16.0), 60.0
_COARSER_PIXEL, _COARSER_STEP = 1.25, 1.5  # times those of the level
_ABOUT_DEG = (-6.0, 6.0, 7), (-3.0, 3.0, 5), (-4.0, 4.0, 3)  # about x, y and z of the camera: from, to, how many
_ABOUT_SHIFT = 0.5  # times `shift_mm`
# Camera axes from LPS for a beam from front to back, the head up.
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class OrbitSearch:
    """Exhaustive search of every other view along the C-arm's orbit, from the first view.

    Costs are the mean over those images of the given kinds that a view has. [all] in `kinds` or `render` stands for
    all. With `shift_mm`, what is drawn may lie so far, up, down and to the sides, from where the orbit has it: a C-arm
    that was rolled or a table that was moved between the views leaves the orbit by a centimetre or two, more than a
    similarity of patches bridges.

    A view whose best cost is above `further_above` is looked for further, up to `further_deg` along the orbit, and with
    the C-arm turned so far about the patient's long axis, tilted towards head or feet, or rolled, while what stands in
    the middle of view 1 stays there: many users centre the hip again. That takes steps of its own, of 4° and 8°, and
    not `step_deg`.
    """

    name: str
    kinds: list[Kind]
    render: list[str]
    half_range_deg: float
    step_deg: float
    level: Level
    similarity: Similarity
    shift_mm: float = 0.0
    further_deg: float = 0.0  # 0: not at all
    further_above: float = 0.0

    def __post_init__(self) -> None:
        degrees = (0, 180)
        check_within(
            self,
            half_range_deg=degrees,
            step_deg=(0.01, 180),
            shift_mm=(0, 200),
            further_deg=degrees,
            further_above=(0, 10),
        )

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`. Raises `InputError` without the images that it needs."""
        if scene.views == 1:
            return ONE_VIEW
        if scene.camera_from_camera1 is not None:
            return CARM_IS_KNOWN
        kinds = chosen_kinds(self.kinds, scene)
        check_known(self.render, kinds, scene, poses)
        for view in range(1, scene.views):
            if not self.images(scene, poses, view):
                reason = lacking(kinds, (view,), scene) or f"the images of view {view + 1} show nothing that it draws"
                raise InputError(f"it finds the C-arm of the other views, but {reason}. Choose another preset.")
        return None

    def images(self, scene: Scene, poses: Poses, view: int) -> list[tuple[Kind, int]]:
        """The images, (kind, view) pairs, of a view (from 0) that show something of what it draws."""
        drawn = chosen_objects(self.render, poses)
        return [
            image for image in scene.there(chosen_kinds(self.kinds, scene), (view,)) if scene.shown(drawn, image[0])
        ]

    def run(self, scene: Scene, poses: Poses, seed: int) -> Iterator[StageRecord]:
        """One search for every other view, see `Step`; nothing is random, and views do not wait for one another."""
        views = range(1, scene.views)
        records = on_all_cores(lambda view: search_orbit(scene, poses, self, view), views, scene.device)
        yield from one_after_another(records, views)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What an image would show from many poses of the C-arm."""

    images: Tensor  # (N, H, W)

    @cached_property
    def gradients(self) -> np.ndarray:
        """What `shift_correlation` compares (N, H, W, 2)."""
        return even_gradients(self.images)


Draw = Callable[[Scene, Poses, OrbitSearch, tuple[Kind, int], Tensor], Drawn]


def drawn_from(scene: Scene, poses: Poses, search: OrbitSearch, image: tuple[Kind, int], cameras: Tensor) -> Drawn:
    """What an image (kind, view) would show with the C-arm at the poses `cameras` (N, 4, 4)."""
    kind, view = image
    names = scene.shown(chosen_objects(search.render, poses), kind)
    where = torch.stack([cameras @ poses.camera1_from[name] for name in names], 1)  # (N, O, 4, 4)
    camera = poses.camera(view, search.level.camera(scene.carm.camera))
    volumes = [search.level.volume(scene.objects[name].volume) for name in names]
    return Drawn(project(volumes, where, camera, search.level.step_mm))


def search_orbit(scene: Scene, poses: Poses, search: OrbitSearch, view: int, draw: Draw = drawn_from) -> StageRecord:
    """Place the C-arm of one view (from 0) at the angle of its orbit, from view 1, that fits its images best.

    `draw` is `drawn_from`, or what gives the same.
    """
    began = time.perf_counter()
    orbit = scene.carm.orbit(orbit_angles(search.half_range_deg, search.step_deg))  # (N, 4, 4)
    found = _best(scene, poses, search, view, orbit, search.shift_mm, draw)
    tries = found.tries
    if search.further_deg and found.cost > search.further_above:
        further = _further(scene, poses, search, view, draw)
        tries += further.tries
        found = min(found, further, key=lambda each: each.cost)
    return StageRecord(
        search.name,
        view + 1,
        found.cost,
        tries,
        time.perf_counter() - began,
        "all angles tried",
        poses.with_view(view, found.camera_from_camera1),
    )


def _further(scene: Scene, poses: Poses, search: OrbitSearch, view: int, draw: Draw) -> "_Best":
    """The best pose of the C-arm away from the range of its orbit."""
    level = search.level
    coarser = replace(level, pixel_mm=_COARSER_PIXEL * level.pixel_mm, step_mm=_COARSER_STEP * level.step_mm)
    middle = _middle(scene, poses)
    coarse, shift_mm = replace(search, level=coarser), _FURTHER_SHIFT * search.shift_mm
    # by themselves: shifted images of one orbit, whose isocentre is not where the file says, correlated best with all
    tried = *orbits(scene, poses, search.further_deg), rolled(scene, poses, search.further_deg)
    every = [_best(scene, poses, coarse, view, orbit, shift_mm, draw) for orbit in tried]
    found = min(every, key=lambda each: each.cost)
    grid = torch.cartesian_prod(*(torch.linspace(*each, dtype=torch.float64) for each in _ABOUT_DEG))
    centre = transform_points(found.camera_from_camera1, middle[None])[0]
    about = about_point(rigid(exp_so3(torch.deg2rad(grid))), centre) @ found.camera_from_camera1
    best = _best(scene, poses, search, view, about, _ABOUT_SHIFT * search.shift_mm, draw)
    return replace(best, tries=best.tries + sum(each.tries for each in every))


def orbits(scene: Scene, poses: Poses, half_range_deg: float) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (N, 4, 4) of the C-arm from view 1: along its orbit, and turned, or tilted too, about the middle of view 1.

    Who centres the hip again after the turn brings the middle back there, whatever the C-arm turned about.
    """
    angles, middle = orbit_angles(half_range_deg, _TURN_STEP_DEG), _middle(scene, poses)
    fewer = orbit_angles(min(half_range_deg, _MOST_TURN_OF_TILTED_DEG), _TURN_STEP_DEG)
    return (
        scene.carm.orbit(angles),
        _turned(scene, middle, angles),
        tilted(poses.camera1_from[scene.anchor], middle, fewer),
    )


def rolled(scene: Scene, poses: Poses, half_range_deg: float) -> Tensor:
    """Poses (N, 4, 4) of a C-arm that was turned about the middle of view 1, and rolled, so that its image is turned.

    The roll leaves the middle where it is seen.
    """
    middle = _middle(scene, poses)
    turned = _turned(scene, middle, orbit_angles(min(half_range_deg, _MOST_TURN_OF_ROLLED_DEG), _TURN_STEP_DEG))
    centres = transform_points(turned, middle[None])[:, 0]  # (N, 3)
    rolls = (about_point(rigid(_about("z", math.radians(deg))), centres) for deg in _ROLLS_DEG)
    return torch.cat([roll @ turned for roll in rolls])


def _turned(scene: Scene, middle: Tensor, angles: Tensor) -> Tensor:
    """Poses (N, 4, 4) of the C-arm, turned by `angles` (N,) about a point of the central beam as deep as `middle`."""
    return replace(scene.carm, isocentre_mm=(0.0, 0.0, float(middle[2]))).orbit(angles)


def _middle(scene: Scene, poses: Poses) -> Tensor:
    """Where that object has its reference point (3,) which stands nearest to the middle of view 1.

    Of objects that the first kind of images shows, if it shows any.
    """
    shown = scene.shown(poses.camera1_from, scene.first_kind) or tuple(poses.camera1_from)
    points = [
        transform_points(poses.camera1_from[name], scene.objects[name].reference_point[None])[0] for name in shown
    ]
    return min(points, key=lambda point: float(point[:2].norm() / point[2]))


def tilted(camera1_from_patient: Tensor, middle: Tensor, angles: Tensor) -> Tensor:
    """Poses (N, 4, 4) of a C-arm that was turned by `angles` (A,) about a patient's long axis, and tilted, from view 1.

    Both about `middle` (3,) of camera 1, which stays where it is. The patient's axes, LPS, are told by the pose (4, 4):
    view 1 may be tilted itself. Some C-arms tilt what turns, others turn what tilts, so both orders are there. What
    turns the image in its plane in view 1 stays. Of a thing that is no patient, the axes of its own space are taken.
    """
    turn, tilt = torch.cartesian_prod(angles, torch.deg2rad(_tilts_deg())).unbind(1)
    other = tilt != 0  # what is not tilted turns alike in both orders
    view_1 = camera1_from_patient[:3, :3] @ camera1_from_patient.new_tensor(_UPRIGHT).mT  # from upright camera axes
    left, up, along = view_1[2].tolist()  # its beam
    turned_first = _about("z", math.atan2(-float(view_1[0, 1]), float(view_1[1, 1]))) @ (
        _about("x", math.asin(max(-1.0, min(1.0, up))) + tilt) @ _about("y", math.atan2(-left, along) + turn)
    )
    tilted_first = _about("z", math.atan2(float(view_1[1, 0]), float(view_1[0, 0]))) @ (
        _about("y", math.asin(max(-1.0, min(1.0, -left))) + turn[other])
        @ _about("x", math.atan2(up, along) + tilt[other])
    )
    return about_point(rigid(torch.cat([turned_first, tilted_first]) @ view_1.mT), middle)


def _tilts_deg() -> Tensor:
    count = round(2 * _MOST_TILT_DEG / _TILT_STEP_DEG) + 1
    return torch.linspace(-_MOST_TILT_DEG, _MOST_TILT_DEG, count, dtype=torch.float64)


def _about(axis: str, angle_rad: Tensor | float) -> Tensor:
    """Rotations (..., 3, 3) about an axis, x, y or z."""
    direction = torch.tensor([float(axis == each) for each in "xyz"], dtype=torch.float64)
    return exp_so3(torch.as_tensor(angle_rad, dtype=torch.float64)[..., None] * direction)


@dataclass(frozen=True)
class _Best:
    cost: float
    camera_from_camera1: Tensor  # (4, 4)
    tries: int


def _best(
    scene: Scene, poses: Poses, search: OrbitSearch, view: int, orbit: Tensor, shift_mm: float, draw: Draw
) -> _Best:
    """Which of the poses (N, 4, 4) of the C-arm fits the images of a view best, each shifted by so much at most."""
    tried = _shifted(scene, poses, search, view, orbit, shift_mm, draw) if shift_mm else orbit
    costs = [
        prepared(scene, image, search.level, search.similarity)(draw(scene, poses, search, image, tried).images)
        for image in search.images(scene, poses, view)
    ]
    values = torch.stack(costs).mean(0).cpu()  # (N,)
    best = int(values.nan_to_num(nan=torch.inf, posinf=torch.inf).argmin())
    return _Best(float(values[best]), tried[best], len(orbit) + (len(tried) if shift_mm else 0))


def _shifted(
    scene: Scene, poses: Poses, search: OrbitSearch, view: int, orbit: Tensor, shift_mm: float, draw: Draw
) -> Tensor:
    """The poses (n, 4, 4) of the orbit whose images fit best once shifted, shifted so."""
    images = search.images(scene, poses, view)
    camera = poses.camera(view, search.level.camera(scene.carm.camera))
    name = scene.shown(chosen_objects(search.render, poses), images[0][0])[0]
    point = transform_points(poses.camera1_from[name], scene.objects[name].reference_point[None])
    depth_mm = transform_points(orbit, point)[:, 0, 2]  # (N,)
    mm_per_pixel = depth_mm[:, None] / camera.sdd_mm * torch.tensor(camera.pixel_mm, dtype=torch.float64)  # (N, 2)
    rows, columns = (shift_mm / mm_per_pixel.mean(0)).ceil().int().tolist()
    maps = [
        shift_correlation(
            draw(scene, poses, search, image, orbit).gradients,
            search.level.image(scene.image(*image), scene.carm.camera),
            exposed_field(scene, image, search.level),
            (rows, columns),
        )
        for image in images
    ]
    values, places = torch.stack(maps).mean(0).flatten(1).max(1)
    best = values.argsort(descending=True)[:_MOST_SHIFTED]
    width = 2 * columns + 1
    off = torch.stack([places // width - rows, places % width - columns], 1)[best] * mm_per_pixel[best]
    moved = torch.eye(4, dtype=torch.float64).repeat(len(best), 1, 1)
    moved[:, :2, 3] = off.flip(1)
    return moved @ orbit[best]
