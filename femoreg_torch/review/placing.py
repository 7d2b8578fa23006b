"""Where a person puts landmarks and objects for a registration to start from, and what the pointer does to them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from femoreg_torch.case import Case, Result
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry import Poses, about_point, exp_se3, invert_rigid, rigid
from femoreg_torch.registration import Scene
from femoreg_torch.registration.prepare.images import view_distortion
from femoreg_torch.registration.scene import reference_point_in_view
from femoreg_torch.registration.start.by_hand import start_by_landmarks
from femoreg_torch.settings import check_within

ALL = "all objects"
Pixel = tuple[float, float]  # column, row
_MOST_PX = 1e5
_NEAREST_MM = 10.0  # of an object to the source: nothing is dragged through it


@dataclass(frozen=True, eq=False)
class Placed:
    """Landmarks in the first image, as its camera sees it, and objects, as far as they have a place."""

    landmarks: dict[str, Pixel]
    poses: Poses
    views: frozenset[int]  # from 0: those whose C-arm's pose is known


@dataclass(frozen=True)
class Move:
    """A motion of one object, or of all, about the reference point of the (first) object, as seen in one view."""

    what: str  # the name of an object, or `all objects`
    view: int  # from 1
    shift_px: list[float] = field(default_factory=lambda: [0.0, 0.0])  # along columns and rows of the image
    turn_deg: float = 0.0  # in the image, clockwise
    tilt_deg: list[float] = field(default_factory=lambda: [0.0, 0.0])  # about the axes of columns and of rows
    depth_mm: float = 0.0  # away from the source, along the ray, so that it stays where it is in the image

    def __post_init__(self) -> None:
        if len(self.shift_px) != 2 or len(self.tilt_deg) != 2:
            raise InputError("shift_px and tilt_deg: two numbers were expected.")
        check_within(self, shift_px=(-_MOST_PX, _MOST_PX), turn_deg=(-180, 180), tilt_deg=(-180, 180))
        check_within(self, depth_mm=(-2000, 2000))


@dataclass(frozen=True)
class Mark:
    """A landmark put somewhere in the first image."""

    name: str
    column: float
    row: float

    def __post_init__(self) -> None:
        check_within(self, column=(-_MOST_PX, _MOST_PX), row=(-_MOST_PX, _MOST_PX))


def placed_at_first(case: Case, scene: Scene, result: Result | None) -> Placed:
    """Poses and landmarks of a result; without one, the objects where a first guess puts them, and no landmarks."""
    known = frozenset(range(scene.views))
    if result is None:
        poses = scene.start(_guess(case, scene))
        return Placed({}, poses, known if scene.camera_from_camera1 is not None else frozenset({0}))
    marks = {} if result.start is None else result.start.landmarks
    seen = {name: mark.pixel for name, mark in marks.items() if mark.visible and name in case.landmarks}
    return Placed(in_camera(case, seen), result.poses, known)


def _guess(case: Case, scene: Scene) -> Tensor:
    """The anchor (4, 4) head up, its reference point in the isocentre, the beam along the axis that the case tells."""
    beam = torch.tensor(case.display_of(0).beam, dtype=torch.float64)
    feet = torch.tensor([0.0, 0, -1], dtype=torch.float64)
    rotation = torch.stack([torch.linalg.cross(feet, beam), feet, beam])
    centre = torch.tensor(case.carm.isocentre_mm, dtype=torch.float64)
    return rigid(rotation, centre - rotation @ scene.objects[scene.anchor].reference_point)


def in_camera(case: Case, stored: Mapping[str, Pixel]) -> dict[str, Pixel]:
    """Places in the first image as stored, as places in what its camera sees."""
    if not stored:
        return {}
    pixels, distortion = torch.tensor(list(stored.values()), dtype=torch.float64), view_distortion(case, 0)
    seen = case.display_of(0).pixels_to_camera(
        pixels if distortion is None else distortion.straight(pixels), case.carm.camera
    )
    return {name: _pair(pixel) for name, pixel in zip(stored, seen, strict=True)}


def as_stored(case: Case, seen: Mapping[str, Pixel]) -> dict[str, Pixel]:
    """The inverse of `in_camera`."""
    if not seen:
        return {}
    pixels, distortion = torch.tensor(list(seen.values()), dtype=torch.float64), view_distortion(case, 0)
    stored = case.display_of(0).pixels_to_stored(pixels, case.carm.camera)
    if distortion is not None:
        stored = torch.from_numpy(distortion.bent(stored.numpy()))
    return {name: _pair(pixel) for name, pixel in zip(seen, stored, strict=True)}


def _pair(pixel: Tensor) -> Pixel:
    column, row = pixel.tolist()
    return column, row


def marked(case: Case, placed: Placed, mark: Mark) -> Placed:
    """With a landmark put somewhere. Raises `InputError` for a name that the case does not know."""
    if mark.name not in case.landmarks:
        raise InputError(f"there is no landmark {shortened(mark.name)}; there are: {', '.join(case.landmarks)}.")
    return replace(placed, landmarks={**placed.landmarks, mark.name: (mark.column, mark.row)})


def unmarked(placed: Placed, name: str) -> Placed:
    """Without a landmark. Raises `InputError` if it is not there."""
    if name not in placed.landmarks:
        raise InputError(f"the landmark {shortened(name)} is not in the image.")
    return replace(placed, landmarks={n: pixel for n, pixel in placed.landmarks.items() if n != name})


def moved(scene: Scene, placed: Placed, move: Move) -> Placed:
    """With objects moved. Raises `InputError` for an unknown name, a view without a pose, or an impossible place."""
    poses, view = placed.poses, move.view - 1
    names = list(poses.camera1_from) if move.what == ALL else [move.what]
    if names[0] not in poses.camera1_from:
        raise InputError(f"there is no object {shortened(move.what)}; there are: {', '.join(poses.camera1_from)}.")
    if view not in placed.views:
        raise InputError(f"where the C-arm stood for view {move.view} is not known yet: nothing can be moved in it.")
    camera = scene.camera(poses, view)
    centre = reference_point_in_view(scene, poses, names[0], view)
    depth = float(centre[2])
    across = [n * size * depth / camera.sdd_mm for n, size in zip(move.shift_px, camera.pixel_mm[::-1], strict=True)]
    shift = torch.tensor([*across, 0.0], dtype=torch.float64) + centre * (move.depth_mm / depth)
    angles = torch.tensor([*map(math.radians, (*move.tilt_deg, move.turn_deg))], dtype=torch.float64)
    turn = exp_se3(torch.cat([angles, torch.zeros(3, dtype=torch.float64)]))
    motion = rigid(translation=shift) @ about_point(turn, centre)
    here = poses.camera_from_camera1[view]
    motion = invert_rigid(here) @ motion @ here
    for name in names:
        poses = poses.with_object(name, motion @ poses.camera1_from[name])
    placed = replace(placed, poses=poses)
    for name in names:
        _check_between(scene, placed, name, "it cannot go there")
    return placed


def by_landmarks(case: Case, scene: Scene, placed: Placed) -> Placed:
    """With what landmarks place put where they say; raises `InputError` as `start_by_landmarks` does."""
    if not scene.needs_landmarks:
        raise InputError("no object of this case starts from landmarks. Move the objects themselves.")
    stored = as_stored(case, placed.landmarks)
    pixels = {name: torch.tensor(pixel, dtype=torch.float64) for name, pixel in stored.items()}
    began = start_by_landmarks(case, scene.anchor, pixels)
    poses = placed.poses
    for name, pose in scene.start(began.camera1_from_object).camera1_from.items():
        if scene.objects[name].start.camera1_from is None:
            poses = poses.with_object(name, pose)
    return replace(placed, poses=poses)


def at_given(scene: Scene, placed: Placed, poses: Mapping[str, Tensor], where: str) -> Placed:
    """With objects at poses (4, 4) of a file `where`. Raises `InputError` for an object or a place that cannot be."""
    for name, pose in poses.items():
        if name not in placed.poses.camera1_from:
            raise InputError(f"{where}: there is no object {shortened(name)} in this case.")
        placed = replace(placed, poses=placed.poses.with_object(name, pose))
        _check_between(scene, placed, name, where)
    return placed


def _check_between(scene: Scene, placed: Placed, name: str, where: str) -> None:
    for view in placed.views:
        at = float(reference_point_in_view(scene, placed.poses, name, view)[2])
        if not _NEAREST_MM <= at <= scene.camera(placed.poses, view).sdd_mm:
            raise InputError(f"{where}: the {name} would not be between source and detector.")
