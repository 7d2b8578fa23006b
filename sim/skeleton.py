"""A case without images: what is known before the operation. Whatever a folder does not hold yet is made here."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from femoreg_torch.case import Case, Device, read_case
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import load_carm
from femoreg_torch.volume import Volume, check_inside, read_ct, read_labels, read_landmarks, read_mesh
from sim.acquisition import Acquisition, nominal_ap, nominal_device
from sim.device import make_device

STRUCTURES = {"pelvis": (1, 2, 4), "femur_left": (5,), "femur_right": (6,)}  # label ids of hips made in this project
_NECK_SHELL_MM = (25.0, 40.0)  # distances from the centre of the head at which a femur is neck
_REACH_MM = 150.0  # the lateral cortex is closer to the head than this
_RAY_STEP_MM = 0.25


def read_skeleton(folder: Path, side: Side, seed: int, settings: Acquisition, device_path: Path) -> Case:
    """The case in `folder` for the operated `side`, without views and truth.

    The folder holds a `case.yaml`, or at least `ct.nii.gz`, `labels.nii.gz` (ids as in `STRUCTURES`) and
    `landmarks.json`. A plan for this side and a device are made where there is none: the entry point by
    `neck_axis_entry`, the device from `seed`, written as STL to `device_path`. The nominal pose of the device follows
    `settings`. Raises `InputError` for what is missing or does not fit together.
    """
    folder = Path(folder)
    if side not in get_args(Side):
        raise InputError(f"side: `left` or `right` was expected, got {side!r}.")
    known = read_case(folder) if (folder / "case.yaml").is_file() else None
    planned = known if known is not None and known.side == side else _planned(known or _bare(folder, side), side)
    if planned.device is None:
        planned = replace(planned, device=_write_device(seed, device_path))
    return _with_nominal_pose(replace(planned, views=(), truth=None), settings)


def _bare(folder: Path, side: Side) -> Case:
    for name in ("ct.nii.gz", "labels.nii.gz", "landmarks.json"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: holds neither case.yaml nor {name}. Make a patient with `femoreg phantom`.")
    landmarks = read_landmarks(folder / "landmarks.json")
    if f"FH-{side[0]}" not in landmarks:
        raise InputError(f"{folder / 'landmarks.json'}: FH-{side[0]}, the head of the operated femur, is missing.")
    unknown = torch.full((3,), torch.nan, dtype=torch.float64)
    return Case(
        folder=folder,
        side=side,
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        structures=STRUCTURES,
        landmarks=landmarks,
        entry_point=unknown,
        target=unknown,
        device=None,
        carm=load_carm("cios_fusion"),
    )


def _planned(case: Case, side: Side) -> Case:
    """The case with a path for this side, from the lateral cortex along the neck into the centre of the head."""
    case = replace(case, side=side)
    if case.labels_path is None:
        raise InputError(f"{case.folder}: has no label map, so no path can be planned for the {side} femur.")
    if case.femur not in case.structures or f"FH-{side[0]}" not in case.landmarks:
        raise InputError(f"{case.folder}: the {side} femur has no labels or no landmark FH-{side[0]}.")
    ct = read_ct(case.ct_path)
    check_inside(case.landmarks, ct)
    labels = read_labels(case.labels_path, ct)
    entry = neck_axis_entry(labels, case.structures[case.femur], case.femoral_head)
    return replace(case, entry_point=entry, target=case.femoral_head)


def neck_axis_entry(labels: Volume, femur: tuple[int, ...], head_centre: Tensor) -> Tensor:
    """Where the axis of the femoral neck leaves the lateral cortex: (3,) in LPS mm.

    The axis runs from the centre of the head (3,) through the centroid of the femur in a spherical shell that holds
    only neck; the entry point is the last point of that ray in the femur. Raises `InputError` if the shell is empty.
    """
    mask = torch.isin(labels.data, torch.tensor(femur, dtype=labels.data.dtype))
    index = mask.nonzero().flip(1).to(torch.float64)  # (N, 3), x y z
    affine = labels.lps_from_index
    points = index @ affine[:3, :3].T + affine[:3, 3]
    distance = (points - head_centre).norm(dim=1)
    shell = points[(distance > _NECK_SHELL_MM[0]) & (distance < _NECK_SHELL_MM[1])]
    if len(shell) == 0:
        raise InputError(
            f"landmark FH at {[round(v, 1) for v in head_centre.tolist()]}: no voxel of the femur lies "
            f"{_NECK_SHELL_MM[0]:g} to {_NECK_SHELL_MM[1]:g} mm from it. Check for RAS/LPS mix-ups."
        )
    axis = torch.nn.functional.normalize(shell.mean(0) - head_centre, dim=0)
    ray = head_centre + torch.arange(0, _REACH_MM, _RAY_STEP_MM, dtype=torch.float64)[:, None] * axis
    voxel = (torch.linalg.inv(affine[:3, :3]) @ (ray - affine[:3, 3]).T).T.round().long()
    size = torch.tensor(labels.data.shape[::-1])
    inside = ((voxel >= 0) & (voxel < size)).all(1)
    x, y, z = voxel[inside].unbind(1)
    return ray[inside][mask[z, y, x]][-1]


def _write_device(seed: int, path: Path) -> Device:
    mesh, points = make_device(seed)
    with temporary_file(path) as part:
        mesh.export(part)
    return Device(path, 5000.0, points, torch.eye(4, dtype=torch.float64))


def _with_nominal_pose(case: Case, settings: Acquisition) -> Case:
    assert case.device is not None
    ap = nominal_ap(case.femoral_head, case.side, settings)
    path_camera = ap[:3, :3] @ (case.target - case.entry_point)
    mesh = read_mesh(case.device.model_path)
    pose = nominal_device(mesh, case.device.points, path_camera, settings.device_depth_mm)
    return replace(case, device=replace(case.device, hu=settings.device_hu, camera1_from_device=pose))
