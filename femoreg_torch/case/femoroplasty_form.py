"""The short form of a femoroplasty in `case.yaml`, and its version 1, where structures are told by their label ids."""

from pathlib import Path
from typing import cast

from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable
from femoreg_torch.anatomy.tables import label_ids
from femoreg_torch.case.femoroplasty import (
    ANATOMY_IMAGES,
    DEVICE,
    DEVICE_END,
    DEVICE_IMAGES,
    DEVICE_POINTS,
    FEMUR,
    PELVIS,
    TEMPLATE,
    Device,
    femoral_head,
    femoroplasty_objects,
    operated_femur,
    planned,
)
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Case, PlannedPath, Side, Start, View
from femoreg_torch.case.models import MODEL_KEYS, read_model
from femoreg_torch.case.nominal import ALONG_PATH, NominalPlace, bone_from_device
from femoreg_torch.case.objects import check_guide, checked_path, plan_points
from femoreg_torch.case.parts import (
    VIEW_KEYS,
    read_bones,
    read_carm,
    read_display,
    read_truth,
    view_of,
    with_known_poses,
)
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.settings import read_record
from femoreg_torch.volume import read_landmarks, read_path_points

SIDES: tuple[Side, ...] = ("left", "right")
KEYS = ("version", "side", "ct", "landmarks", "plan", "device", "carm", "display", "views", "truth")
DEVICE_STARTS = (f"camera1_from_{DEVICE}", f"{FEMUR}_from_{DEVICE}", "start")
_STRUCTURES = (PELVIS, *(operated_femur(side) for side in SIDES))


def read_femoroplasty(top: Fields, folder: Path) -> Case:
    """The case of a `template: femoroplasty`. Raises `InputError` that names file and key."""
    top.only("template", *KEYS)
    ct = top.mapping("ct").only("image", "labels", "bones")
    bones = read_bones(ct, folder, HIP) if "labels" in ct else {}
    return _read(top, folder, ct, bones)


def read_version_1(top: Fields, folder: Path) -> Case:
    """The case of a file of version 1. Raises `InputError` that names file and key."""
    top.only(*KEYS)
    ct = top.mapping("ct").only("image", "labels", "structures")
    side = _side(top)
    bones = _structures(ct, side) if "structures" in ct or "labels" in ct else {}
    return _read(top, folder, ct, bones)


def _side(top: Fields) -> Side:
    return cast(Side, top.choice("side", SIDES))


def _structures(ct: Fields, side: Side) -> LabelTable:
    """Label ids of the pelvis as a whole, and of femora."""
    structures = ct.mapping("structures").only(*_STRUCTURES)
    for name in (PELVIS, operated_femur(side)):
        structures.value(name, "a list of label ids")
    found: LabelTable = {}
    for name in structures.content:
        where = structures.where(name)
        value = structures.value(name, "a list of label ids")
        if not isinstance(value, list):
            raise InputError(f"{where}: a list of label ids was expected, found {shortened(value)}.")
        ids = label_ids(value, where)
        for other, taken in found.items():
            if shared := set(ids) & set(taken):
                raise InputError(f"{where}: label {min(shared)} belongs to {other} already.")
        found[name] = ids
    return found


def _read(top: Fields, folder: Path, ct: Fields, bones: LabelTable) -> Case:
    side = _side(top)
    femur, head = operated_femur(side), femoral_head(side)
    if bones:
        for name in (PELVIS, femur):
            if name not in bones and not set(HIP.members(name)) & set(bones):
                raise InputError(f"{ct.where('bones')}: has no id of the {name}. It has: {', '.join(bones)}.")
    landmarks = read_landmarks(top.file_path("landmarks", folder))
    if head not in landmarks:
        raise InputError(f"{top.where('landmarks')}: {head}, the head of the operated femur, is missing.")
    views = tuple(read_view(view, folder) for view in top.mappings("views")) if "views" in top else ()
    entry_point, target, file = read_path(top, folder, landmarks, side)
    path = checked_path(planned(entry_point, target, None), top.where("plan"))
    device = read_device(top.mapping("device"), folder, path, side) if "device" in top else None
    objects = femoroplasty_objects(side, landmarks[head], device)
    display = read_display(top)
    truth, truth_source = read_truth(top, folder, list(objects), len(views))
    return Case(
        folder=folder,
        carm=read_carm(top, display, views),
        objects=objects,
        views=with_known_poses(views, top),
        anatomy=HIP,
        ct_path=ct.file_path("image", folder, may_be_folder=True),
        labels_path=ct.file_path("labels", folder, may_be_folder=True) if "labels" in ct else None,
        bones=bones,
        landmarks=landmarks,
        plan=planned(entry_point, target, device, file),
        truth=truth,
        truth_source=truth_source,
        template=TEMPLATE,
        side=side,
        display=display,
    )


def read_path(
    top: Fields, folder: Path, landmarks: dict[str, Tensor], side: Side
) -> tuple[Tensor, Tensor, Path | None]:
    """Entry point (3,) and target (3,), LPS mm, under `plan`, and the plan.json that they stand in, if any.

    They are points, a file of markups of 3D Slicer, or those of the plan.json. Without a target it is the operated
    femoral head. Raises `InputError`.
    """
    if isinstance(top.value("plan", "{entry_point, target} or a file of 3D Slicer markups"), str):
        entry_point, end = read_path_points(top.file_path("plan", folder))
        return entry_point, landmarks[femoral_head(side)] if end is None else end, None
    plan, file = plan_points(top.mapping("plan").only("file", "entry_point", "target"), folder, side)
    return plan.point("entry_point"), _target(plan, landmarks, side), file


def _target(plan: Fields, landmarks: dict[str, Tensor], side: Side) -> Tensor:
    target = plan.value("target", "a landmark, as FH, or a point [x, y, z]")
    if not isinstance(target, str):
        return plan.point("target")
    name = f"{target}-{side[0]}"
    if name not in HIP.landmark_names:
        stems = ", ".join(dict.fromkeys(known.rpartition("-")[0] for known in HIP.landmark_names))
        raise InputError(
            f"{plan.where('target')}: one of {stems} (of the operated side) or a point [x, y, z] in LPS mm was "
            f"expected, found {shortened(target)}."
        )
    if name not in landmarks:
        raise InputError(f"{plan.where('target')}: landmark {name} is not in the landmark file.")
    return landmarks[name]


def read_device(device: Fields, folder: Path, path: PlannedPath, side: Side) -> Device:
    """The device, with its nominal pose told in one of three ways. Raises `InputError`."""
    device.only(*MODEL_KEYS, "points", *DEVICE_STARTS)
    points = read_device_points(device, folder)
    return Device(read_model(device, folder), points, read_device_start(device, folder, path, side, points))


def read_device_points(device: Fields, folder: Path) -> dict[str, Tensor]:
    """The points (3,) of the device, mm in its space: written out, or a file of markups. Raises `InputError`."""
    if isinstance(device.value("points", "{tip, base, center}, or a file of 3D Slicer markups"), str):
        points = read_landmarks(device.file_path("points", folder), (*DEVICE_POINTS, DEVICE_END))
        if missing := [name for name in DEVICE_POINTS if name not in points]:
            raise InputError(f"{device.where('points')}: the file lacks {', '.join(missing)}.")
    else:
        named = device.mapping("points").only(*DEVICE_POINTS, DEVICE_END)
        wanted = (*DEVICE_POINTS, DEVICE_END) if DEVICE_END in named else DEVICE_POINTS
        points = {name: named.point(name) for name in wanted}
    check_guide(points, f"{device.where('points')}.tip")
    return points


def read_device_start(device: Fields, folder: Path, path: PlannedPath, side: Side, points: dict[str, Tensor]) -> Start:
    """The nominal pose: in camera 1, beside the femur, or in words. Raises `InputError`."""
    in_camera, beside, words = DEVICE_STARTS
    told = [key for key in DEVICE_STARTS if key in device]
    if len(told) > 1:
        raise InputError(
            f"{device.where(told[1])}: the nominal pose of the device is given {len(told)} times, as "
            f"{' and '.join(f'`{key}`' for key in told)}. Keep one of them."
        )
    if not told:
        raise InputError(
            f"{device.where(in_camera)}: is missing, the nominal pose of the device was expected once, as "
            f"`{in_camera}` (4×4), `{beside}` (4×4 or a transform of 3D Slicer), or `{words}: {{guide: {ALONG_PATH}, "
            f"before_entry_mm: 20}}`."
        )
    if in_camera in device:
        return Start(camera1_from=device.transform(in_camera))
    if beside in device:
        return Start(beside=FEMUR, beside_from_object=device.transform_or_file(beside, folder))
    sentence = device.mapping(words)
    place = read_record(NominalPlace, sentence.content, device.where(words))
    return Start(beside=FEMUR, beside_from_object=bone_from_device(place, path, side, points))


def read_view(view: Fields, folder: Path) -> View:
    """A view with images by kind, and what else is told of it. Raises `InputError`."""
    view.only(ANATOMY_IMAGES, DEVICE_IMAGES, *VIEW_KEYS)
    images = {ANATOMY_IMAGES: view.file_path(ANATOMY_IMAGES, folder)}
    if DEVICE_IMAGES in view:
        images[DEVICE_IMAGES] = view.file_path(DEVICE_IMAGES, folder)
    return view_of(images, view, folder)
