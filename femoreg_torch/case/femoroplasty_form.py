"""The short form of a femoroplasty in `case.yaml`, and its version 1, where structures are told by their label ids."""

from pathlib import Path
from typing import cast

import torch

from femoreg_torch.anatomy import HIP, LabelTable
from femoreg_torch.anatomy.tables import label_ids
from femoreg_torch.case.femoroplasty import (
    ANATOMY_IMAGES,
    DEVICE,
    DEVICE_IMAGES,
    DEVICE_POINTS,
    PELVIS,
    TEMPLATE,
    Device,
    femoral_head,
    femoroplasty_objects,
    operated_femur,
    planned,
)
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Case, Side, View
from femoreg_torch.case.models import MODEL_KEYS, read_model
from femoreg_torch.case.objects import check_guide, checked_path
from femoreg_torch.case.parts import (
    read_bones,
    read_carm,
    read_field,
    read_intensity,
    read_known_pose,
    read_truth,
    with_known_poses,
)
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.volume import read_landmarks

SIDES: tuple[Side, ...] = ("left", "right")
_KEYS = ("version", "side", "ct", "landmarks", "plan", "device", "carm", "views", "truth")
_STRUCTURES = (PELVIS, *(operated_femur(side) for side in SIDES))


def read_femoroplasty(top: Fields, folder: Path) -> Case:
    """The case of a `template: femoroplasty`. Raises `InputError` that names file and key."""
    top.only("template", *_KEYS)
    ct = top.mapping("ct").only("image", "labels", "bones")
    bones = read_bones(ct, folder, HIP) if "labels" in ct else {}
    return _read(top, folder, ct, bones)


def read_version_1(top: Fields, folder: Path) -> Case:
    """The case of a file of version 1. Raises `InputError` that names file and key."""
    top.only(*_KEYS)
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
    views = tuple(_view(view, folder) for view in top.mappings("views")) if "views" in top else ()
    device = _device(top.mapping("device"), folder) if "device" in top else None
    objects = femoroplasty_objects(side, landmarks[head], device)
    plan = top.mapping("plan").only("entry_point", "target")
    return Case(
        folder=folder,
        carm=read_carm(top),
        objects=objects,
        views=with_known_poses(views, top),
        anatomy=HIP,
        ct_path=ct.file_path("image", folder, may_be_folder=True),
        labels_path=ct.file_path("labels", folder) if "labels" in ct else None,
        bones=bones,
        landmarks=landmarks,
        plan=checked_path(planned(side, plan.point("entry_point"), _target(plan, landmarks, side), device), plan),
        truth=read_truth(top, folder, list(objects), len(views)),
        template=TEMPLATE,
        side=side,
    )


def _target(plan: Fields, landmarks: dict[str, torch.Tensor], side: Side) -> torch.Tensor:
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


def _device(device: Fields, folder: Path) -> Device:
    device.only(*MODEL_KEYS, "points", f"camera1_from_{DEVICE}")
    named = device.mapping("points").only(*DEVICE_POINTS)
    points = {name: named.point(name) for name in DEVICE_POINTS}
    check_guide(points, named.where("tip"))
    return Device(read_model(device, folder), points, device.transform(f"camera1_from_{DEVICE}"))


def _view(view: Fields, folder: Path) -> View:
    view.only(ANATOMY_IMAGES, DEVICE_IMAGES, "intensity", "camera_from_camera1", "field")
    images = {ANATOMY_IMAGES: view.file_path(ANATOMY_IMAGES, folder)}
    if DEVICE_IMAGES in view:
        images[DEVICE_IMAGES] = view.file_path(DEVICE_IMAGES, folder)
    return View(images, read_intensity(view), read_known_pose(view), read_field(view, folder))
