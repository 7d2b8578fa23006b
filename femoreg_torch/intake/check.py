"""Everything that is wrong with a case, at once, and a picture of how it was understood: `femoreg check`."""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, Anatomy, LabelTable
from femoreg_torch.case import Case, femoroplasty_form, read_case
from femoreg_torch.case.femoroplasty import (
    ANATOMY_IMAGES,
    DEVICE,
    DEVICE_IMAGES,
    DEVICE_POINTS,
    FEMUR,
    PELVIS,
    TEMPLATE,
    femoral_head,
    operated_femur,
    planned,
)
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import PlannedPath, Side, View
from femoreg_torch.case.models import MODEL_KEYS, read_model
from femoreg_torch.case.parts import (
    VIEW_KEYS,
    read_bones,
    read_carm,
    read_display,
    read_field,
    read_frames,
    read_grid,
    read_intensity,
    read_known_pose,
)
from femoreg_torch.case.reading import read_fields
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display, check_matches, read_image
from femoreg_torch.geometry import CArm
from femoreg_torch.intake.planes import Picture, three_planes
from femoreg_torch.intake.start_picture import picture_of_start
from femoreg_torch.intake.volumes import ct_warnings, described, nifti_warnings
from femoreg_torch.pnp import MINIMUM
from femoreg_torch.registration.models import model_attenuation
from femoreg_torch.volume import (
    BoneLabels,
    Volume,
    bone_labels,
    check_inside,
    read_ct_told,
    read_labels_told,
    read_landmarks,
    stray_landmarks,
    swapped_sides,
)
from femoreg_torch.volume.bones import nearest_label
from femoreg_torch.volume.borders import cut_bones

_T = TypeVar("_T")
_ANY_PATH = PlannedPath(FEMUR, torch.zeros(3).double(), torch.ones(3).double())
_ANY_POINTS = {name: n * torch.ones(3).double() for n, name in enumerate(DEVICE_POINTS)}
_FAR_MM = 150.0  # from the middle of a device, beyond its own size, no point of it lies
_FAR_FROM_BONE_MM = 400.0  # a device that starts farther from the entry point is likely told wrong


@dataclass(frozen=True, eq=False)
class Checked:
    """What was found; the picture (H, W, 3) is blue, green, red."""

    problems: tuple[str, ...]  # what keeps the case from being registered rightly
    warnings: tuple[str, ...]  # what may be as it should
    facts: tuple[str, ...]  # how the case was understood
    picture: Picture | None = None


@dataclass
class _Found:
    """Collects what is wrong, each once."""

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)

    def attempt(self, read: Callable[[], _T]) -> _T | None:
        """What `read` gives, or None if it raises `InputError`, which is then a problem."""
        try:
            return read()
        except InputError as error:
            self.problem(str(error))
            return None

    def problem(self, told: str) -> None:
        line = " ".join(told.split())
        if line not in self.problems:
            self.problems.append(line)

    def unknown_keys(self, fields: Fields, known: Sequence[str]) -> None:
        """Every key that is not known is a problem."""
        for key in fields.content:
            if key not in known:
                self.attempt(lambda key=key: Fields({key: 0}, fields.file, fields.path).only(*known))  # type: ignore[misc]


@dataclass(frozen=True, eq=False)
class _Anatomy:
    """CT, bones and landmarks, as far as they could be read."""

    ct: Volume | None = None
    bones: BoneLabels | None = None
    landmarks: Mapping[str, Tensor] = field(default_factory=dict)
    anatomy: Anatomy | None = None


def check_case(folder: Path, find_start: bool = True, landmarks: Mapping[str, Tensor] | None = None) -> Checked:
    """All problems of the case in `folder`, in words, each with file and key.

    Where nothing is wrong, and `find_start`, its start pose is looked for, by `landmarks` (2,) in pixels of the first
    image or by the network, and drawn.
    """
    folder, found = Path(folder), _Found()
    top = found.attempt(lambda: read_fields(folder))
    if top is None:
        return Checked(tuple(found.problems), (), ())
    short = top.content.get("template") == TEMPLATE and top.content.get("version") == 2
    seen = _check_femoroplasty(top, folder, found) if short else _Anatomy()
    case = None
    if not found.problems:
        case = found.attempt(lambda: read_case(folder))
    if case is not None and not short:
        seen = _check_written_out(case, found)
    picture = _planes(seen, case)
    if case is not None and case.views and find_start and not found.problems:
        start = found.attempt(lambda: picture_of_start(case, landmarks))
        if start is not None:
            found.facts += start.facts
            picture = start.picture if picture is None else start.below(picture)
    return Checked(tuple(found.problems), tuple(found.warnings), tuple(found.facts), picture)


def _check_femoroplasty(top: Fields, folder: Path, found: _Found) -> _Anatomy:
    """Every part of the short form by itself, so that a fault in one hides none in another."""
    found.unknown_keys(top, ("template", *femoroplasty_form.KEYS))
    side = cast("Side | None", found.attempt(lambda: top.choice("side", femoroplasty_form.SIDES)))
    marks = found.attempt(lambda: read_landmarks(top.file_path("landmarks", folder))) or {}
    display = found.attempt(lambda: read_display(top)) or Display()
    views = _readable_views(top, folder)
    carm = found.attempt(lambda: read_carm(top, display, views))
    ct = found.attempt(lambda: top.mapping("ct"))
    seen = _Anatomy(landmarks=marks, anatomy=HIP)
    if ct is not None:
        found.unknown_keys(ct, ("image", "labels", "bones"))
        seen = _check_ct(ct, folder, marks, found)
    _check_landmarks(seen, found)
    path = None
    if side is not None:
        if marks and femoral_head(side) not in marks:
            found.problem(
                f"{top.where('landmarks')}: {femoral_head(side)}, the head of the operated femur, is missing."
            )
        elif marks:
            path = found.attempt(lambda: _path(top, folder, marks, side))
        if seen.bones is not None:
            for bone in (PELVIS, operated_femur(side)):
                found.attempt(lambda bone=bone: seen.bones.of((bone,), HIP))  # type: ignore[misc]
            found.warnings += cut_bones(
                seen.bones.labels, seen.bones.ids, ("hip_left", "hip_right", operated_femur(side))
            )
        if path is not None:
            _check_path(path, side, seen, found)
    if DEVICE in top:
        _check_device(top, folder, path, side, found)
    _check_views(top, folder, carm, display, found)
    if "truth" in top:
        found.attempt(lambda: top.file_path("truth", folder))
    return seen


def _path(top: Fields, folder: Path, marks: dict[str, Tensor], side: Side) -> PlannedPath:
    entry_point, target, _ = femoroplasty_form.read_path(top, folder, marks, side)
    return planned(side, entry_point, target, None)


def _check_ct(ct: Fields, folder: Path, marks: dict[str, Tensor], found: _Found) -> _Anatomy:
    path = found.attempt(lambda: ct.file_path("image", folder, may_be_folder=True))
    labels_path = None
    if "labels" not in ct:
        found.problem(
            f"{ct.where('labels')}: is missing, a label map of the bones was expected. `femoreg segment` makes one."
        )
    else:
        labels_path = found.attempt(lambda: ct.file_path("labels", folder, may_be_folder=True))
    table = found.attempt(lambda: read_bones(ct, folder, HIP)) if labels_path is not None else None
    volume = None
    read = None if path is None else found.attempt(lambda: read_ct_told(path))
    if read is not None and path is not None:
        volume, told = read
        found.warnings += [*told, *nifti_warnings(path), *ct_warnings(volume)]
        found.facts.append(f"CT: {described(volume)}")
    bones = None
    if volume is not None and labels_path is not None and table is not None:
        bones = found.attempt(lambda: _bones(labels_path, volume, table, HIP, marks, found))
    return _Anatomy(volume, bones, marks, HIP)


def _bones(
    path: Path, ct: Volume, table: LabelTable, anatomy: Anatomy | None, marks: Mapping[str, Tensor], found: _Found
) -> BoneLabels:
    labels, told = read_labels_told(path, ct, {n for ids in table.values() for n in ids})
    found.warnings += told
    bones = bone_labels(labels, ct, table, anatomy, marks)
    found.facts.append(f"bones: {', '.join(bones.ids)}")
    for bone, ids in bones.absent.items():
        found.warnings.append(f"no voxel of {path.name} carries the label {', '.join(map(str, ids))}, the {bone}")
    return bones


def _check_landmarks(seen: _Anatomy, found: _Found) -> None:
    if seen.landmarks and len(seen.landmarks) < MINIMUM:
        found.problem(
            f"landmarks: {len(seen.landmarks)} of them, but the start pose takes at least {MINIMUM}. Place more of "
            f"{', '.join(HIP.landmark_names)}."
        )
    outside = set()
    if seen.ct is not None:
        for name, point in seen.landmarks.items():
            try:
                check_inside({name: point}, seen.ct)
            except InputError as error:
                found.problem(str(error))
                outside.add(name)
    if seen.bones is not None:
        inside = {name: point for name, point in seen.landmarks.items() if name not in outside}
        swapped = swapped_sides(seen.bones, inside, seen.anatomy)
        for told in swapped or stray_landmarks(seen.bones, inside, seen.anatomy):
            found.problem(f"{told}.")


def _check_path(path: PlannedPath, side: Side, seen: _Anatomy, found: _Found) -> None:
    """The entry point lies on the operated femur, and the target nearer to its head."""
    if not (path.target - path.entry_point).norm() > 1e-6:
        found.problem("plan: entry point and target are the same point, so the path has no direction. Move one.")
        return
    head = seen.landmarks[femoral_head(side)]
    if (path.entry_point - head).norm() < (path.target - head).norm():
        found.problem("plan: the entry point lies nearer to the femoral head than the target. Exchange the two.")
    if seen.bones is None or operated_femur(side) not in seen.bones.ids:
        return  # which is told
    femora = {seen.bones.ids[name]: name for name in ("femur_left", "femur_right") if name in seen.bones.ids}
    ends = {"entry point": path.entry_point, "target": path.target}
    for name, point in ends.items():
        if torch.equal(point, head):
            continue  # a landmark, which is looked at by itself
        label = nearest_label(seen.bones.labels, list(femora), point)
        where = ", ".join(f"{v:.1f}" for v in point.tolist())
        if label is None:
            found.problem(
                f"plan: the {name} ({where}) mm LPS lies near no femur of the label map. Check RAS/LPS, or move it."
            )
        elif femora[label] != operated_femur(side):
            found.problem(
                f"plan: the {name} lies on the {femora[label]}, but `side` is {side}. Correct one of the two."
            )


def _check_device(top: Fields, folder: Path, path: PlannedPath | None, side: Side | None, found: _Found) -> None:
    device = found.attempt(lambda: top.mapping(DEVICE))
    if device is None:
        return
    found.unknown_keys(device, (*MODEL_KEYS, "points", *femoroplasty_form.DEVICE_STARTS))
    model = found.attempt(lambda: read_model(device, folder))
    points = _device_points(device, folder, found)
    volume = None if model is None else found.attempt(lambda: model_attenuation(model).volume)
    if volume is not None:
        size = torch.tensor(volume.data.shape[::-1]) * torch.tensor(volume.spacing_mm)
        for name, point in points.items():
            away = float((point - volume.centre()).norm())
            if away > float(size.norm()) / 2 + _FAR_MM:
                found.problem(
                    f"{device.where('points')}.{name}: lies {away:.0f} mm from the middle "
                    "of the device. Points are mm in the space of its model; check units and RAS/LPS."
                )
    known = path is not None and side is not None and set(points) == set(DEVICE_POINTS)
    # what a pose in words depends on may be at fault itself: with anything in its place the words are still looked at
    on, along, of = (path, side, points) if known else (_ANY_PATH, "left", _ANY_POINTS)
    start = found.attempt(lambda: femoroplasty_form.read_device_start(device, folder, on, along, of))  # type: ignore[arg-type]
    if not known or path is None:
        return
    if start is not None and start.beside == FEMUR and start.camera1_from is None:
        femur_from_device = start.beside_from_object
        tip = femur_from_device[:3, :3] @ points["tip"] + femur_from_device[:3, 3]
        away = float((tip - path.entry_point).norm())
        found.facts.append(f"device: its tip starts {away:.0f} mm from the entry point")
        if away > _FAR_FROM_BONE_MM:
            found.warnings.append(f"device: its tip would start {away:.0f} mm from the entry point")


def _device_points(device: Fields, folder: Path, found: _Found) -> dict[str, Tensor]:
    if isinstance(device.content.get("points"), dict):
        named = device.mapping("points")
        found.unknown_keys(named, DEVICE_POINTS)
        told = {name: found.attempt(lambda name=name: named.point(name)) for name in DEVICE_POINTS}  # type: ignore[misc]
        points = {name: point for name, point in told.items() if point is not None}
        if set(points) != set(DEVICE_POINTS):
            return points
    return found.attempt(lambda: femoroplasty_form.read_device_points(device, folder)) or {}


def _readable_views(top: Fields, folder: Path) -> list[View]:
    """The views in which nothing is wrong; what is wrong with the others is told by `_check_views`."""
    read: list[View] = []
    try:
        views = top.mappings("views")
    except InputError:
        return read
    for view in views:
        try:
            read.append(femoroplasty_form.read_view(view, folder))
        except InputError:
            continue
    return read


def _check_views(top: Fields, folder: Path, carm: CArm | None, display: Display, found: _Found) -> None:
    views = found.attempt(lambda: top.mappings("views"))
    if views is None:
        return
    if not views:
        found.problem(f"{top.where('views')}: empty. At least one fluoroscopic image is needed.")
    read: dict[str, Tensor] = {}
    kinds = (ANATOMY_IMAGES, DEVICE_IMAGES)
    for view in views:
        found.unknown_keys(view, (ANATOMY_IMAGES, DEVICE_IMAGES, *VIEW_KEYS))
        shown = display
        if "display" in view:
            shown = found.attempt(lambda view=view: read_display(view)) or display  # type: ignore[misc]
        by_folder = (lambda one: read_field(one, folder), lambda one: read_grid(one, folder))
        for get in (read_intensity, read_known_pose, read_frames, *by_folder):
            found.attempt(lambda get=get, view=view: cast(Callable[[Fields], Any], get)(view))  # type: ignore[misc]
        for kind in kinds:
            if kind == DEVICE_IMAGES and kind not in view:
                continue
            path = found.attempt(lambda view=view, kind=kind: view.file_path(kind, folder))  # type: ignore[misc]
            image = None if path is None else found.attempt(lambda path=path: read_image(path))  # type: ignore[misc]
            if image is None:
                continue
            where = view.where(kind)
            read[where] = image
            if carm is not None:
                camera = shown.stored_camera(carm.camera)
                found.attempt(functools.partial(check_matches, image, camera, f"{where}: it"))
    _check_different(read, found)
    if DEVICE in top and views and not any(DEVICE_IMAGES in view for view in views):
        found.warnings.append("no view has an image with the device, so it will not be found")


def _check_different(images: Mapping[str, Tensor], found: _Found) -> None:
    for (one, first), (other, second) in itertools.combinations(images.items(), 2):
        if torch.equal(first, second):
            found.problem(f"{other}: the same image as {one.rpartition(', ')[2]}. Give every exposure its own image.")


def _check_written_out(case: Case, found: _Found) -> _Anatomy:
    """What can be seen of a case that could be read, of any form."""
    _check_images(case, found)
    for thing in case.objects.values():
        if thing.model is not None:
            found.attempt(lambda thing=thing: model_attenuation(thing.model))  # type: ignore[misc]
    if case.ct_path is None or case.labels_path is None:
        return _Anatomy(landmarks=case.landmarks, anatomy=case.anatomy)
    read = found.attempt(lambda: read_ct_told(cast(Path, case.ct_path)))
    if read is None:
        return _Anatomy(landmarks=case.landmarks, anatomy=case.anatomy)
    ct, told = read
    found.warnings += [*told, *nifti_warnings(case.ct_path), *ct_warnings(ct)]
    found.facts.append(f"CT: {described(ct)}")
    labels_path = case.labels_path
    bones = found.attempt(lambda: _bones(labels_path, ct, case.bones, case.anatomy, case.landmarks, found))
    if bones is not None:
        for thing in case.objects.values():
            if thing.model is None:
                found.attempt(lambda thing=thing: bones.of(thing.bones, case.anatomy))  # type: ignore[misc]
    seen = _Anatomy(ct, bones, case.landmarks, case.anatomy)
    _check_landmarks(seen, found)
    return seen


def _check_images(case: Case, found: _Found) -> None:
    read: dict[str, Tensor] = {}
    for number, view in enumerate(case.views):
        camera = case.display_of(number).stored_camera(case.carm.camera)
        for kind, path in view.images.items():
            image = found.attempt(lambda path=path: read_image(path))  # type: ignore[misc]
            if image is not None:
                where = f"{case.folder}/case.yaml, views[{number}].{kind}"
                read[where] = image
                found.attempt(functools.partial(check_matches, image, camera, f"{where}: it"))
    _check_different(read, found)


def _planes(seen: _Anatomy, case: Case | None) -> Picture | None:
    """Three planes of the CT with bones, landmarks and the planned path, as far as they could be read."""
    if seen.ct is None:
        return None
    marks = dict(seen.landmarks)
    if case is not None and case.plan is not None:
        marks["entry"] = case.plan.entry_point
    colours = {}
    if seen.bones is not None and seen.anatomy is not None:
        names = [bone.name for bone in seen.anatomy.bones if bone.name in seen.bones.ids]
        colours = {seen.bones.ids[name]: seen.anatomy.bone(name).colour for name in names}
    head = seen.landmarks.get(femoral_head(case.side)) if case is not None and case.side is not None else None
    return three_planes(seen.ct, None if seen.bones is None else seen.bones.labels, colours, marks, head)
