"""How far a registration is from the truth: equations 5 to 13 of the paper.

Gao et al., Fiducial-free 2D/3D registration for robot-assisted femoroplasty, IEEE Trans Med Robot Bionics 2 (2020) 437.

Differences are taken in the camera frame of view 1 and told along the paper's axes: x = IS towards the head (camera
−y), y = LR towards the patient's left (camera +x), z = AP towards the back, the depth (camera +z): a right-handed set.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.case import Case, Truth
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import euler_xyz_deg, invert_rigid, rotation_angle, transform_points
from femoreg_torch.volume import read_ct, read_labels

PAPER_FROM_CAMERA = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)


@dataclass(frozen=True)
class ReferencePoints:
    """The points (3,) in mm at which errors are told: LPS for bone, CAD for the device."""

    pelvis: Tensor  # middle of the pelvis
    femoral_head: Tensor
    entry_point: Tensor
    target: Tensor
    device: dict[str, Tensor] | None = None  # its tip, base and center


def reference_points(case: Case) -> ReferencePoints:
    """Reference points of a case; that of the pelvis is the middle of its labels' bounding box.

    Reads the label map; raises `InputError` if there is none, or none of the pelvis in it.
    """
    if case.labels_path is None:
        raise InputError(f"{case.folder}: has no label map to find the middle of the pelvis. Add `ct.labels`.")
    labels = read_labels(case.labels_path, read_ct(case.ct_path))
    ids = torch.tensor(case.structures["pelvis"], dtype=labels.data.dtype)
    found = torch.isin(labels.data, ids).nonzero()
    if len(found) == 0:
        raise InputError(f"{case.labels_path}: no voxel carries a label of the pelvis ({ids.tolist()}).")
    middle = (found.amin(0) + found.amax(0)).flip(0).to(torch.float64) / 2
    pelvis = transform_points(labels.lps_from_index, middle[None])[0]
    return ReferencePoints(
        pelvis=pelvis,
        femoral_head=case.femoral_head,
        entry_point=case.entry_point,
        target=case.target,
        device=case.device.points if case.device else None,
    )


def errors(truth: Truth, estimate: Truth, points: ReferencePoints) -> dict[str, Any]:
    """Errors of an estimate, the rows of the paper's Tables I and II.

    `pelvis`, `femur`, `device` (equations 5 and 6), `view2`, `view3`, … (7 and 8): `{mm, deg, mm_xyz, deg_xyz}` with
    the displacement of the reference point (of a view: of its source) and the axis angle, and signed along IS, LR, AP,
    the rotation as xyz Euler angles. `entry_point_mm` (9), `tip_mm` (10), `relative_mm` (11), `path_deg` (12),
    `guide_deg` (13). What needs the device is left out where truth or estimate has none. Raises `InputError` if the
    numbers of views differ.
    """
    if len(truth.camera_from_pelvis) != len(estimate.camera_from_pelvis):
        raise InputError(
            f"errors: the truth has {len(truth.camera_from_pelvis)} views, the estimate "
            f"{len(estimate.camera_from_pelvis)}. Are they of the same case?"
        )
    rows: dict[str, Any] = {
        "pelvis": _row(truth.camera_from_pelvis[0], estimate.camera_from_pelvis[0], points.pelvis),
        "femur": _row(truth.camera1_from_femur, estimate.camera1_from_femur, points.femoral_head),
    }
    entry = _displacement(truth.camera1_from_femur, estimate.camera1_from_femur, points.entry_point)
    path = points.target - points.entry_point
    metrics = {
        "entry_point_mm": entry.norm().item(),
        "path_deg": _angle_deg(truth.camera1_from_femur, estimate.camera1_from_femur, path),
    }
    true_device, device = truth.camera1_from_device, estimate.camera1_from_device
    if true_device is not None and device is not None and points.device is not None:
        rows["device"] = _row(true_device, device, points.device["center"])
        tip = _displacement(true_device, device, points.device["tip"])
        metrics["tip_mm"] = tip.norm().item()
        metrics["relative_mm"] = (entry - tip).norm().item()
        metrics["guide_deg"] = _angle_deg(true_device, device, points.device["tip"] - points.device["base"])

    source = torch.zeros(3, dtype=torch.float64)
    views = zip(_camera1_from_camera(truth)[1:], _camera1_from_camera(estimate)[1:], strict=True)
    for number, (true_pose, pose) in enumerate(views, 2):
        rows[f"view{number}"] = _row(true_pose, pose, source)
    return rows | metrics


def _camera1_from_camera(poses: Truth) -> Tensor:
    return poses.camera_from_pelvis[0] @ invert_rigid(poses.camera_from_pelvis)


def _displacement(true_pose: Tensor, pose: Tensor, point: Tensor) -> Tensor:
    """Estimated minus true place (3,) of a point, in the frame that the poses map into."""
    return (transform_points(pose, point[None]) - transform_points(true_pose, point[None]))[0]


def _row(true_pose: Tensor, pose: Tensor, point: Tensor) -> dict[str, Any]:
    shift = _displacement(true_pose, pose, point)
    turn = pose[:3, :3] @ true_pose[:3, :3].T
    return {
        "mm": shift.norm().item(),
        "deg": math.degrees(rotation_angle(turn).item()),
        "mm_xyz": (PAPER_FROM_CAMERA @ shift).tolist(),
        "deg_xyz": euler_xyz_deg(PAPER_FROM_CAMERA @ turn @ PAPER_FROM_CAMERA.T).tolist(),
    }


def _angle_deg(true_pose: Tensor, pose: Tensor, direction: Tensor) -> float:
    """Angle between the true and the estimated direction; atan2 stays exact for small angles."""
    a, b = true_pose[:3, :3] @ direction, pose[:3, :3] @ direction
    return math.degrees(torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).item())
