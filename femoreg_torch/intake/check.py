"""Everything that is wrong with a case, at once, and a picture of how it was understood: `femoreg check`."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, femoroplasty_form, read_case
from femoreg_torch.case.femoroplasty import (
    DEVICE,
    DEVICE_END,
    DEVICE_POINTS,
    FEMUR,
    PELVIS,
    TEMPLATE,
    femoral_head,
    operated_femur,
    planned,
)
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import PlannedPath, Side
from femoreg_torch.case.models import MODEL_KEYS, read_model
from femoreg_torch.case.parts import read_carm, read_display, read_truth
from femoreg_torch.case.reading import read_fields, read_version
from femoreg_torch.errors import in_mm
from femoreg_torch.fluoro import Display
from femoreg_torch.intake.check_anatomy import (
    SeenAnatomy,
    check_bones,
    check_ct,
    check_head,
    check_heads,
    check_landmarks,
    check_path,
    planes_of,
)
from femoreg_torch.intake.check_images import check_images, check_views, readable_views
from femoreg_torch.intake.found import Found, alike_together
from femoreg_torch.intake.planes import Picture, side_by_side, stacked
from femoreg_torch.intake.start_picture import picture_of_start
from femoreg_torch.intake.volumes import ct_warnings, described, header_warnings
from femoreg_torch.registration.prepare.models import (
    BEYOND_MM,
    GUIDE_MM,
    model_attenuation,
    told_of_end,
    told_of_leaning,
    told_of_middle,
)
from femoreg_torch.registration.prepare.nominal import check_start
from femoreg_torch.volume import NOBODY, is_in_ras, patient_of, read_ct_told, read_landmarks
from femoreg_torch.volume.borders import cut_bones
from femoreg_torch.volume.round_field import round_field

_ANY_PATH = PlannedPath(FEMUR, torch.zeros(3).double(), torch.ones(3).double())
_ANY_POINTS = {name: n * torch.ones(3).double() for n, name in enumerate(DEVICE_POINTS)}
_TOLD_OF_GUIDES = told_of_end, told_of_middle, told_of_leaning
_FAR_MM = 150.0  # from the middle of a device, beyond its own size, no point of it lies
_FAR_FROM_BONE_MM = 400.0  # a device that starts farther from the entry point is likely told wrong


@dataclass(frozen=True, eq=False)
class Checked:
    """What was found; the picture (H, W, 3) is blue, green, red."""

    problems: tuple[str, ...]  # what keeps the case from being registered rightly
    warnings: tuple[str, ...]  # what may be as it should
    facts: tuple[str, ...]  # how the case was understood
    picture: Picture | None = None


def check_case(folder: Path, find_start: bool = True, landmarks: Mapping[str, Tensor] | None = None) -> Checked:
    """All problems of the case in `folder`, in words, each with file and key.

    What could be read of CT, bones, landmarks and images is drawn. Where nothing is wrong, and `find_start`, the start
    pose is looked for, by `landmarks` (2,) in pixels of the first image or by the network, and drawn over that image.
    """
    folder, found = Path(folder), Found()
    top = found.attempt(lambda: read_fields(folder))
    if top is None:
        return Checked(tuple(found.problems), (), ())
    version = found.attempt(lambda: read_version(top))
    short = top.content.get("template") == TEMPLATE and version != 1
    seen, images = _check_femoroplasty(top, folder, found) if short else (SeenAnatomy(), {})
    case = None
    if not found.problems:
        case = found.attempt(lambda: read_case(folder))
    if case is not None:
        _check_starts(case, found)
    if case is not None and not short:
        seen, images = _check_written_out(case, found)
    below = side_by_side(images)
    if case is not None and case.views and find_start and not found.problems:
        start = found.attempt(lambda: picture_of_start(case, landmarks))
        if start is not None:
            found.facts += [fact for fact in start.facts if fact not in found.warnings]
            found.warnings += start.warnings
            below = start.picture
    picture = stacked(planes_of(seen, case), below)
    return Checked(tuple(alike_together(found.problems)), tuple(found.warnings), tuple(found.facts), picture)


def _check_starts(case: Case, found: Found) -> None:
    """Nominal poses of models that are not in the beam."""
    for thing in case.objects.values():
        point = thing.reference if thing.reference is not None else thing.points.get("tip")
        if thing.model is not None and point is not None:
            pose, where = thing.start.camera1_from, f"{case.folder}/case.yaml"
            found.attempt(partial(check_start, thing.name, pose, point, case.carm.camera.sdd_mm, where))


def _check_femoroplasty(top: Fields, folder: Path, found: Found) -> tuple[SeenAnatomy, dict[str, Tensor]]:
    """Every part of the short form by itself, so that a fault in one hides none in another; also the images, by key."""
    found.unknown_keys(top, ("template", *femoroplasty_form.KEYS))
    side = cast("Side | None", found.attempt(lambda: top.choice("side", femoroplasty_form.SIDES)))
    marks = found.attempt(lambda: read_landmarks(top.file_path("landmarks", folder))) or {}
    display = found.attempt(lambda: read_display(top))
    views = readable_views(top, folder)
    carm = found.attempt(lambda: read_carm(top, display or Display(), views))
    ct = found.attempt(lambda: top.mapping("ct"))
    seen = SeenAnatomy(landmarks=marks, anatomy=HIP)
    if ct is not None:
        found.unknown_keys(ct, ("image", "labels", "bones"))
        seen = check_ct(ct, folder, marks, found)
    check_landmarks(seen, found)
    check_heads(seen, found)
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
            cut = ("hip_left", "hip_right", operated_femur(side))
            circle = None if seen.ct is None else round_field(seen.ct)
            found.warnings += cut_bones(seen.bones.labels, seen.bones.ids, cut, circle)
            check_head(side, seen, found)
        if path is not None:
            check_path(path, side, seen, found)
    if DEVICE in top:
        _check_device(top, folder, path, side, found)
    images = check_views(top, folder, carm, display, seen.patient, found)
    if "truth" in top:
        names = [PELVIS, FEMUR, *([DEVICE] if DEVICE in top else [])]
        count = len(found.attempt(lambda: top.mappings("views")) or ())
        found.attempt(lambda: read_truth(top, folder, names, count))
    return seen, images


def _path(top: Fields, folder: Path, marks: dict[str, Tensor], side: Side) -> PlannedPath:
    entry_point, target, _ = femoroplasty_form.read_path(top, folder, marks, side)
    return planned(entry_point, target, None)


def _check_device(top: Fields, folder: Path, path: PlannedPath | None, side: Side | None, found: Found) -> None:
    device = found.attempt(lambda: top.mapping(DEVICE))
    if device is None:
        return
    found.unknown_keys(device, (*MODEL_KEYS, "points", *femoroplasty_form.DEVICE_STARTS))
    model = found.attempt(lambda: read_model(device, folder))
    if model is not None and model.path.is_file() and is_in_ras(model.path):
        found.warnings.append(
            f"{model.path.name} says that its coordinates are RAS, and they are taken as they stand: the points of the "
            "device have to be in the same space"
        )
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
            elif (beyond := volume.beyond_mm(point)) > BEYOND_MM:
                box = " × ".join(f"{mm:.3g}" for mm in size.tolist())
                found.warnings.append(
                    f"device: its point {name} lies {beyond:.0f} mm outside the box of its model, which has {box} mm. "
                    "Has the model another unit (inches) or origin than the points?"
                )
    if volume is not None and "tip" in points and volume.beyond_mm(points["tip"]) <= BEYOND_MM:  # else enough is said
        found.warnings += [line for tell in _TOLD_OF_GUIDES for line in tell("device", volume, points)]
    if {"tip", "base"} <= set(points):
        length = float((points["tip"] - points["base"]).norm())
        if not GUIDE_MM[0] <= length <= GUIDE_MM[1]:
            found.warnings.append(
                f"device: its tip lies {in_mm(length)} from its base. Is the model in mm? (Inches are 25.4 of them.)"
            )
    known = path is not None and side is not None and set(points) >= set(DEVICE_POINTS)
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


def _device_points(device: Fields, folder: Path, found: Found) -> dict[str, Tensor]:
    if isinstance(device.content.get("points"), dict):
        named = device.mapping("points")
        found.unknown_keys(named, (*DEVICE_POINTS, DEVICE_END))
        wanted = (*DEVICE_POINTS, DEVICE_END) if DEVICE_END in named else DEVICE_POINTS
        told = {name: found.attempt(lambda name=name: named.point(name)) for name in wanted}  # type: ignore[misc]
        points = {name: point for name, point in told.items() if point is not None}
        if set(points) != set(wanted):
            return points
    return found.attempt(lambda: femoroplasty_form.read_device_points(device, folder)) or {}


def _check_written_out(case: Case, found: Found) -> tuple[SeenAnatomy, dict[str, Tensor]]:
    """What can be seen of a case that could be read, of any form; also its images, by key."""
    ct_path = case.ct_path
    patient = None if ct_path is None else found.attempt(lambda: patient_of(ct_path))
    images = check_images(case, patient or NOBODY, found)
    for thing in case.objects.values():
        if thing.model is not None:
            model = found.attempt(lambda thing=thing: model_attenuation(thing.model))  # type: ignore[misc]
            if model is not None:
                found.warnings += [
                    line for tell in _TOLD_OF_GUIDES for line in tell(thing.name, model.volume, thing.points)
                ]
    if ct_path is None or case.labels_path is None:
        return SeenAnatomy(landmarks=case.landmarks, anatomy=case.anatomy), images
    read = found.attempt(lambda: read_ct_told(ct_path))
    if read is None:
        return SeenAnatomy(landmarks=case.landmarks, anatomy=case.anatomy), images
    ct, told = read
    found.warnings += [*told, *header_warnings(ct_path), *ct_warnings(ct)]
    found.facts.append(f"CT: {described(ct)}")
    labels_path = case.labels_path
    bones = found.attempt(lambda: check_bones(labels_path, ct, case.bones, case.anatomy, case.landmarks, found))
    if bones is not None:
        for thing in case.objects.values():
            if thing.model is None:
                found.attempt(lambda thing=thing: bones.of(thing.bones, case.anatomy))  # type: ignore[misc]
    seen = SeenAnatomy(ct, bones, case.landmarks, case.anatomy)
    check_landmarks(seen, found)
    check_heads(seen, found)
    return seen, images
