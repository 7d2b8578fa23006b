"""How sure poses from beads are, along the paper's axes, and what that leaves open of the errors measured by them.

First order: a twist (ω, t) about c moves a point p by ω × (p − c) + t and turns a direction d by ω × d, so that the
covariance of either follows from that of the twists (Hartley and Zisserman, Multiple View Geometry, 2nd ed. 2004,
section 5.2).
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.beads.bundle import Bundle
from femoreg_torch.evaluation import ReferencePoints
from femoreg_torch.evaluation.errors import paper_from_camera
from femoreg_torch.geometry import Poses, invert_rigid, transform_points
from femoreg_torch.geometry.rigid import skew

_PAPER_FROM_CAMERA = paper_from_camera("anterior")  # images of another source are refused


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the poses of objects: twists (rad, mm) about their reference points, axes of camera 1."""

    objects: tuple[str, ...]
    covariance: Tensor  # (6K, 6K)

    def of(self, *names: str) -> Tensor:
        """The covariance (6n, 6n) of some objects, in this order."""
        rows = torch.cat([6 * self.objects.index(name) + torch.arange(6) for name in names])
        return self.covariance[rows][:, rows]


def pose_uncertainty(found: Bundle, points: ReferencePoints) -> Uncertainty:
    """The covariance of a bundle's objects about their reference points."""
    moves = []
    for number, name in enumerate(found.objects):
        place = transform_points(found.poses.camera1_from[name], points.objects[name][None])[0]
        moves.append(_moved(place - found.centres[number]))
    shift = torch.block_diag(*moves)
    size = len(shift)
    return Uncertainty(found.objects, shift @ found.covariance[:size, :size] @ shift.T)


def _moved(arm: Tensor) -> Tensor:
    """What takes a twist about c to the same motion as a twist about c + arm: (6, 6)."""
    change = torch.eye(6, dtype=torch.float64)
    change[3:, :3] = -skew(arm)
    return change


def object_rows(sure: Uncertainty) -> dict[str, dict[str, Any]]:
    """Standard deviations of every object: `{mm, deg, mm_xyz, deg_xyz}`, total and along IS, LR, AP of view 1."""
    rows = {}
    for name in sure.objects:
        turned = _PAPER_FROM_CAMERA @ sure.of(name)[:3, :3] @ _PAPER_FROM_CAMERA.T
        shifted = _PAPER_FROM_CAMERA @ sure.of(name)[3:, 3:] @ _PAPER_FROM_CAMERA.T
        rows[name] = {
            "mm": float(shifted.trace().sqrt()),
            "deg": math.degrees(float(turned.trace().sqrt())),
            "mm_xyz": shifted.diagonal().sqrt().tolist(),
            "deg_xyz": torch.rad2deg(turned.diagonal().sqrt()).tolist(),
        }
    return rows


def view_rows(found: Bundle) -> dict[str, dict[str, Any]]:
    """The same of `camera1_from_camera<K>` at the source of camera K, as the errors of views are told."""
    rows = {}
    known = len(found.objects)
    for number in range(1, len(found.poses.camera_from_camera1)):
        at = 6 * (known + number - 1)
        covariance = found.covariance[at : at + 6, at : at + 6]
        turn = _PAPER_FROM_CAMERA @ invert_rigid(found.poses.camera_from_camera1[number])[:3, :3]
        about_source = _moved(-found.centres[known + number - 1])
        covariance = about_source @ covariance @ about_source.T
        turned, shifted = (turn @ block @ turn.T for block in (covariance[:3, :3], covariance[3:, 3:]))
        rows[f"view{number + 1}"] = {
            "mm": float(shifted.trace().sqrt()),
            "deg": math.degrees(float(turned.trace().sqrt())),
            "mm_xyz": shifted.diagonal().sqrt().tolist(),
            "deg_xyz": torch.rad2deg(turned.diagonal().sqrt()).tolist(),
        }
    return rows


def metric_deviations(sure: Uncertainty, poses: Poses, points: ReferencePoints) -> dict[str, float]:
    """Root mean square of what each error of the planned path would be, were the registration right and only this off.

    Keys as in `evaluation.errors`: `entry_point_mm`, `path_deg`, and with a tool `tip_mm`, `relative_mm`, `guide_deg`.
    """
    plan = points.plan
    if plan is None or plan.object not in sure.objects:
        return {}
    place = poses.camera1_from[plan.object]
    entry = _at(place, plan.entry_point, points.objects[plan.object])
    rows = {
        "entry_point_mm": _length(entry, sure.of(plan.object)),
        "path_deg": _angle_deg(place[:3, :3] @ (plan.target - plan.entry_point), sure.of(plan.object)),
    }
    if plan.tool is None or points.guide is None or plan.tool not in sure.objects:
        return rows
    base, end = points.guide
    tool = poses.camera1_from[plan.tool]
    tip = _at(tool, end, points.objects[plan.tool])
    both = torch.cat([entry, -tip], 1)
    return rows | {
        "tip_mm": _length(tip, sure.of(plan.tool)),
        "relative_mm": _length(both, sure.of(plan.object, plan.tool)),
        "guide_deg": _angle_deg(tool[:3, :3] @ (end - base), sure.of(plan.tool)),
    }


def _at(pose: Tensor, point: Tensor, reference: Tensor) -> Tensor:
    """Displacement (3, 6) of a point by a twist about the reference point."""
    arm = pose[:3, :3] @ (point - reference)
    return torch.cat([-skew(arm), torch.eye(3, dtype=torch.float64)], 1)


def _length(by_twist: Tensor, covariance: Tensor) -> float:
    return float((by_twist @ covariance @ by_twist.T).trace().clamp_min(0).sqrt())


def _angle_deg(direction: Tensor, covariance: Tensor) -> float:
    turned = -skew(direction / direction.norm())
    return math.degrees(float((turned @ covariance[:3, :3] @ turned.T).trace().clamp_min(0).sqrt()))
