"""What is wrong with CT, label map, landmarks and planned path of a case, and the three planes that show them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, Anatomy, LabelTable
from femoreg_torch.case import Case
from femoreg_torch.case.femoroplasty import femoral_head, operated_femur
from femoreg_torch.case.femoroplasty_form import SIDES
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import PlannedPath, Side
from femoreg_torch.case.parts import read_bones
from femoreg_torch.errors import InputError
from femoreg_torch.intake.found import Found
from femoreg_torch.intake.planes import Picture, three_planes
from femoreg_torch.intake.volumes import ct_warnings, described, header_warnings
from femoreg_torch.pnp import MINIMUM
from femoreg_torch.registration.prepare.plan_and_landmarks import (
    MOST_OFF_BONE_MM,
    MOST_OFF_HEAD_MM,
    told_of_bare_bone,
)
from femoreg_torch.segment import Head, doubted_radius, doubted_slices, head_of
from femoreg_torch.volume import (
    NOBODY,
    BoneLabels,
    Patient,
    Volume,
    bone_labels,
    check_inside,
    densities,
    has_names,
    landmarks_beside_bones,
    landmarks_without_bones,
    merged_bones,
    misplaced_labels,
    patient_of,
    read_ct_told,
    read_labels_told,
    segment_names,
    soft_bones,
    stray_landmarks,
    swapped_sides,
    turned_labels,
)
from femoreg_torch.volume.bones import nearest_voxel
from femoreg_torch.volume.lost_slices import told_of_lost_slice

_MOST_NAMES = 8


@dataclass(frozen=True, eq=False)
class SeenAnatomy:
    """CT, bones and landmarks, as far as they could be read."""

    ct: Volume | None = None
    bones: BoneLabels | None = None
    landmarks: Mapping[str, Tensor] = field(default_factory=dict)
    anatomy: Anatomy | None = None
    patient: Patient = NOBODY  # of the CT, by its header

    @cached_property
    def heads(self) -> dict[Side, Head]:
        """By side, the spheres that fit the femoral heads of the bones."""
        fitted = {} if self.bones is None else {side: head_of(self.bones, side) for side in SIDES}
        return {side: head for side, head in fitted.items() if head is not None}


def check_ct(ct: Fields, folder: Path, marks: dict[str, Tensor], found: Found) -> SeenAnatomy:
    """CT and label map of a femoroplasty, and what is wrong with them, for `found`; `marks` (3,), LPS mm, by name."""
    path = found.attempt(lambda: ct.file_path("image", folder, may_be_folder=True))
    labels_path = None
    if "labels" not in ct:
        found.problem(
            f"{ct.where('labels')}: is missing, a label map of the bones was expected. `femoreg segment` makes one."
        )
    else:
        labels_path = found.attempt(lambda: ct.file_path("labels", folder, may_be_folder=True))
    table = found.attempt(lambda: read_bones(ct, folder, HIP)) if labels_path is not None else None
    volume, patient = None, NOBODY
    read = None if path is None else found.attempt(lambda: read_ct_told(path))
    if read is not None and path is not None:
        (volume, told), patient = read, patient_of(path)
        found.warnings += [*told, *header_warnings(path), *ct_warnings(volume)]
        found.facts.append(f"CT: {described(volume)}")
    bones = None
    if volume is not None and labels_path is not None and table is not None:
        bones = found.attempt(lambda: check_bones(labels_path, volume, table, HIP, marks, found))
    return SeenAnatomy(volume, bones, marks, HIP, patient)


def check_bones(
    path: Path, ct: Volume, table: LabelTable, anatomy: Anatomy | None, marks: Mapping[str, Tensor], found: Found
) -> BoneLabels:
    """The bones of a label map on the grid of a CT, HU, and what contradicts that, for `found`. Raises `InputError`."""
    wanted = {n for ids in table.values() for n in ids}
    labels, done, against = read_labels_told(path, ct, wanted)
    found.warnings += [*done, *against, *(f"{path.name}: {warning}" for warning in header_warnings(path))]
    bones = bone_labels(labels, ct, table, anatomy, marks)
    seen = densities(ct, bones.labels)
    if seen.unscaled is not None:
        found.problem(f"{seen.unscaled}.")
    elif seen.light is not None:
        found.warnings.append(seen.light)
    elif (turned := turned_labels(ct, bones.labels)) is not None:
        found.warnings.append(turned)
    elif (misplaced := misplaced_labels(ct, bones.labels, list(bones.ids.values()))) is not None:
        found.warnings.append(misplaced)
    elif (elsewhere := seen.elsewhere or soft_bones(ct, bones.labels, bones.ids)) is not None:
        found.warnings.append(elsewhere)
    lost = told_of_lost_slice(ct, bones.labels, list(bones.ids.values()))
    found.warnings += [] if lost is None else [lost]
    found.facts.append(f"bones: {', '.join(bones.ids)}")
    names = [name for name, ids in segment_names(path).items() if not wanted & set(ids)] if has_names(path) else []
    if names:
        found.facts.append(f"parts of {path.name} that are taken for no bone: {some_of(names)}")
    for bone, ids in bones.absent.items():
        numbers = ", ".join(map(str, ids))
        if anatomy is None or anatomy.landmarks_of(bone):
            found.warnings.append(
                f"no voxel of {path.name} carries the label {numbers}, the {bone}: right if the CT shows none"
            )
        else:  # vertebrae and sacrum: few CTs of a hip show all that a table names
            found.facts.append(f"not in {path.name}: {bone}")
    return bones


def some_of(names: list[str]) -> str:
    """The first few of many names."""
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more


def check_landmarks(seen: SeenAnatomy, found: Found) -> None:
    """What is wrong with landmarks of the CT, for `found`: their number, the CT's border, sides, places off bones."""
    if seen.landmarks and len(seen.landmarks) < MINIMUM:
        found.warnings.append(f"landmarks: {len(seen.landmarks)} of them; {_of_few(seen)}.")
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
        merged = merged_bones(seen.bones, inside, seen.anatomy)
        for told in swapped or [*stray_landmarks(seen.bones, inside, seen.anatomy), *merged]:
            found.problem(f"{told}.")
        found.warnings += landmarks_without_bones(seen.bones, inside, seen.anatomy)
        if not swapped:
            found.warnings += landmarks_beside_bones(seen.bones, inside, seen.anatomy)


def _of_few(seen: SeenAnatomy) -> str:
    """In words, what too few landmarks mean for the start, and which of the anatomy's could be placed too."""
    outlined = seen.anatomy is not None and seen.anatomy.outline
    means = (
        f"with fewer than {MINIMUM} the start pose hangs on the outlines of the bones"
        if outlined
        else f"a start pose by landmarks needs {MINIMUM}"
    )
    names = [] if seen.anatomy is None else seen.anatomy.landmark_names
    missing = [name for name in names if name not in seen.landmarks]
    return f"{means}. Place more of {', '.join(missing)}" if missing else means


def check_heads(seen: SeenAnatomy, found: Found) -> None:
    """Femoral heads are as large as those of adults, and as long from head to foot as across."""
    if seen.bones is None:
        return
    for side, head in seen.heads.items():
        found.warnings += doubted_radius(side, head.radius_mm) if head.is_round else []
    found.warnings += doubted_slices(seen.heads.values(), seen.bones.labels.spacing_mm)


def check_head(side: Side, seen: SeenAnatomy, found: Found) -> None:
    """The operated femoral head lies in the middle of the sphere that fits the bone's, and among labelled bones."""
    name = femoral_head(side)
    if seen.ct is not None and seen.bones is not None and name in seen.landmarks:
        found.warnings += told_of_bare_bone(name, seen.landmarks[name], seen.ct, seen.bones)
    head = seen.heads.get(side)
    if head is None or not (head.may_be_one and head.is_round) or name not in seen.landmarks:
        return
    off = float((head.centre - seen.landmarks[name]).norm())
    if off > MOST_OFF_HEAD_MM:
        where = ", ".join(f"{v:.1f}" for v in head.centre.tolist())
        found.warnings.append(
            f"landmarks: {name} lies {off:.0f} mm from the middle of the sphere that fits the femoral head of the "
            f"label map, ({where}) mm LPS: look at it"
        )


def check_path(path: PlannedPath, side: Side, seen: SeenAnatomy, found: Found) -> None:
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
        near = nearest_voxel(seen.bones.labels, list(femora), point)
        where = ", ".join(f"{v:.1f}" for v in point.tolist())
        if near is None:
            found.problem(
                f"plan: the {name} ({where}) mm LPS lies near no femur of the label map. Check RAS/LPS, or move it."
            )
        elif femora[near[0]] != operated_femur(side):
            found.problem(
                f"plan: the {name} lies on the {femora[near[0]]}, but `side` is {side}. Correct one of the two."
            )
        elif near[1] > MOST_OFF_BONE_MM:
            found.warnings.append(
                f"plan: the {name} ({where}) mm LPS lies {near[1]:.0f} mm outside the femur: look at it"
            )


def planes_of(seen: SeenAnatomy, case: Case | None) -> Picture | None:
    """Three planes of the CT with bones, landmarks and the planned path, as far as they could be read."""
    if seen.ct is None:
        return None
    marks = dict(seen.landmarks)
    if case is not None and case.plan is not None:
        marks["entry"] = case.plan.entry_point
    colours, ids = {}, {}
    if seen.bones is not None and seen.anatomy is not None:
        names = [bone.name for bone in seen.anatomy.bones if bone.name in seen.bones.ids]
        colours = {seen.bones.ids[name]: seen.anatomy.bone(name).colour for name in names}
        ids = {seen.bones.ids[name]: name for name in names}
    head = seen.landmarks.get(femoral_head(case.side)) if case is not None and case.side is not None else None
    labels = None if seen.bones is None else seen.bones.labels
    return three_planes(seen.ct, labels, colours, marks, head, names=ids)
