"""A case without images: what is known before the operation. Whatever a folder does not hold yet is made here."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.case import Case, read_case
from femoreg_torch.case.femoroplasty import (
    TEMPLATE,
    Device,
    device_of,
    femoral_head,
    femoroplasty_objects,
    operated_femur,
    planned,
    with_device,
)
from femoreg_torch.case.model import Model, PlannedPath, Side, Start
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import load_carm
from femoreg_torch.paths import check_readable
from femoreg_torch.volume import check_inside, read_ct, read_labels, read_landmarks, read_mesh
from sim.theatre.device import make_device
from sim.theatre.nominal_poses import nominal_ap, nominal_device
from sim.theatre.planned_path import neck_axis_entry
from sim.theatre.settings import Simulation

_CARM = "cios_fusion"  # where neither case nor settings name one
_FILES = ("ct.nii.gz", "labels.nii.gz", "landmarks.json")  # of a patient; ids of the table `femoreg`


@dataclass(frozen=True, eq=False)
class Preoperative:
    """A femoroplasty before its first image, and those parts of it that its simulation needs."""

    case: Case  # without views and truth
    side: Side  # operated
    head: Tensor  # (3,) centre of the operated femoral head, LPS mm
    femur: tuple[int, ...]  # ids of the operated femur in the label map
    ct_path: Path
    labels_path: Path
    device: Device


def read_preoperative(folder: Path, side: Side, seed: int, settings: Simulation, device_path: Path) -> Preoperative:
    """The procedure on the patient in `folder`, for the operated `side`.

    The folder holds a `case.yaml`, or at least `ct.nii.gz`, `labels.nii.gz` (with the ids of the label table `femoreg`)
    and `landmarks.json`. A plan for this side and a device are made where there is none: the entry point by
    `neck_axis_entry`, the device from `seed`, written as STL to `device_path`. The nominal pose of the device follows
    `settings`. Raises `InputError` for what is missing or does not fit together.
    """
    folder = Path(folder)
    if side not in get_args(Side):
        raise InputError(f"side: `left` or `right` was expected, got {shortened(side)}.")
    case = read_case(folder) if (folder / "case.yaml").is_file() else _bare(folder)
    ct_path, labels_path = case.ct_path, case.labels_path
    if ct_path is None or labels_path is None:
        raise InputError(
            f"{folder}: CT and label map are needed to simulate. Add `ct.image` and `ct.labels` to case.yaml."
        )
    name, bone = femoral_head(side), operated_femur(side)
    if name not in case.landmarks:
        raise InputError(f"{folder}: the landmark {name}, the head of the operated femur, is missing.")
    if bone not in case.bones:
        raise InputError(
            f"{folder}: no id of the label map is known to be {bone}. Known bones: {', '.join(case.bones)}."
        )
    head, femur = case.landmarks[name], case.bones[bone]
    path = case.plan if case.side == side else None
    if path is None:
        path = _planned(case, head, femur, ct_path, labels_path)
    device = _at_nominal_pose(device_of(case) or _write_device(seed, device_path), path, head, side, settings)
    case = replace(
        case,
        side=side,
        template=TEMPLATE,
        objects=femoroplasty_objects(side, head, None),
        plan=path,
        views=(),
        truth=None,
        carm=case.carm if settings.carm is None else load_carm(settings.carm),
    )
    return Preoperative(with_device(case, device), side, head, femur, ct_path, labels_path, device)


def _bare(folder: Path) -> Case:
    """The case of a folder that holds a patient alone."""
    for name in _FILES:
        check_readable(folder / name, f"{folder} holds no case.yaml either. Make a patient with `femoreg phantom`.")
    ct, labels, landmarks = (folder / name for name in _FILES)
    return Case(
        folder=folder,
        carm=load_carm(_CARM),
        objects={},
        anatomy=HIP,
        ct_path=ct,
        labels_path=labels,
        bones=label_table("femoreg"),
        landmarks=read_landmarks(landmarks),
    )


def _planned(case: Case, head: Tensor, femur: tuple[int, ...], ct_path: Path, labels_path: Path) -> PlannedPath:
    """A path from the lateral cortex along the neck into the centre of the head."""
    ct = read_ct(ct_path)
    check_inside(case.landmarks, ct)
    return planned(neck_axis_entry(read_labels(labels_path, ct), femur, head), head, None)


def _write_device(seed: int, path: Path) -> Device:
    mesh, points = make_device(seed)
    with temporary_file(path) as part:
        mesh.export(part)
    return Device(Model(path, None), points, Start(camera1_from=torch.eye(4, dtype=torch.float64)))


def _at_nominal_pose(device: Device, path: PlannedPath, head: Tensor, side: Side, settings: Simulation) -> Device:
    """The device at its nominal pose, of the material that the settings say. Raises `InputError` if it has parts."""
    if device.model.parts:
        raise InputError(
            f"{device.model.path.parent}: the device has parts, but a simulation images one mesh. Give `model` with a "
            "mesh of the whole device and its `hu`."
        )
    ap = nominal_ap(head, side, settings.acquisition)
    path_camera = ap[:3, :3] @ (path.target - path.entry_point)
    mesh = read_mesh(device.model.path)
    pose = nominal_device(mesh, device.points, path_camera, settings.acquisition.device_depth_mm)
    model = replace(device.model, hu=settings.acquisition.device_hu, material=None)
    return replace(device, model=model, start=Start(camera1_from=pose))
