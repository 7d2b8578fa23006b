"""The 14 landmarks of a labelled CT, proposed by the rules that the landmark network was trained with."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.segment.heads import doubted_radius
from femoreg_torch.segment.rules import DOUBTED_RESIDUAL_MM, HEAD_RADIUS_MM, SIDES, find_surface_landmarks
from femoreg_torch.segment.surface import STEP_MM, bone_surface
from femoreg_torch.volume import BoneLabels, Volume
from femoreg_torch.volume.round_field import RoundField, round_field

_BORDER_MM = 4.0  # a point so near to the CT's border, or its round field's, may be where the CT ends and no landmark
_LEAST_ML = 15.0  # of a hip bone or femur that is looked at


@dataclass(frozen=True, eq=False)
class Proposal:
    """Landmarks by name, in the order of the anatomy's; those that could not be found are left out."""

    points: dict[str, Tensor]  # (3,) LPS mm, float64
    expected_error_mm: dict[str, float]  # root mean square distance to expect
    head_radius_mm: dict[str, float]  # by side
    head_residual_mm: dict[str, float]  # by side: of the head's surface in the socket from the sphere
    left_out: dict[str, str]  # why, by name
    warnings: tuple[str, ...]


def propose_landmarks(ct: Volume, bones: BoneLabels) -> Proposal:
    """Landmarks of the hip from its bones, with the error to expect of each.

    Raises `InputError` if no hip bone is there.
    """
    voxel_ml = float(np.prod(ct.spacing_mm)) / 1000
    wanted = [f"{bone}_{side}" for bone in ("hip", "femur") for side in SIDES]
    volume = {
        name: int((bones.labels.data == bones.ids[name]).sum()) * voxel_ml for name in wanted if name in bones.ids
    }
    surfaces = {name: bone_surface(bones.labels, bones.ids[name]) for name in volume if volume[name] >= _LEAST_ML}
    if not any(name.startswith("hip") for name in surfaces):
        raise InputError("landmarks: the label map holds no hip bone to find landmarks on.")
    found = find_surface_landmarks(surfaces, whole=False, edge_mm=STEP_MM * math.sqrt(3))
    points = {name: torch.from_numpy(np.asarray(point, np.float64)) for name, point in found.points.items()}
    left_out: dict[str, str] = {}
    warnings: list[str] = []
    field = round_field(ct)
    for name in HIP.landmark_names:
        if name not in points:
            left_out[name] = "its bone, or what is needed of it, is not in the label map"
        elif not _well_inside(points[name], ct):
            left_out[name] = "lies at the border of the CT"
        elif field is not None and _within_mm(points[name], ct, field) < _BORDER_MM:
            left_out[name] = "lies at the edge of the round field of the CT"
    for side, radius in found.head_radius.items():
        name, residual = f"FH-{side[0]}", found.head_residual[side]
        if not HEAD_RADIUS_MM[0] <= radius <= HEAD_RADIUS_MM[1]:
            left_out[name] = f"the sphere fitted to the head has a radius of {radius:.0f} mm"
            continue
        warnings += doubted_radius(side, radius)
        if residual > DOUBTED_RESIDUAL_MM:
            warnings.append(f"{name}: the head lies {residual:.1f} mm (root mean square) off a sphere: look at it")
    kept = {name: points[name] for name in HIP.landmark_names if name in points and name not in left_out}
    errors = {}
    for landmark in HIP.landmarks:
        if landmark.name in kept:
            side = next(side for side in SIDES if landmark.name.endswith(f"-{side[0]}"))
            residual = found.head_residual.get(side, 0.0) if landmark.name.startswith("FH") else 0.0
            errors[landmark.name] = _expected_error(landmark.spread_mm, ct.spacing_mm, residual)
    return Proposal(kept, errors, found.head_radius, found.head_residual, left_out, tuple(warnings))


def _well_inside(point: Tensor, ct: Volume) -> bool:
    room = [_BORDER_MM / s for s in ct.spacing_mm]
    return all(r <= i <= n - 1 - r for i, n, r in zip(_index(point, ct), ct.data.shape[::-1], room, strict=True))


def _within_mm(point: Tensor, ct: Volume, field: RoundField) -> float:
    x, y, _ = _index(point, ct)
    return float(field.within_mm(torch.tensor(x * ct.spacing_mm[0]), torch.tensor(y * ct.spacing_mm[1])))


def _index(point: Tensor, ct: Volume) -> list[float]:
    """x, y and z of a point (3,), LPS mm, in voxels."""
    index: list[float] = (
        torch.linalg.inv(ct.lps_from_index) @ torch.cat([point, torch.ones(1, dtype=torch.float64)])
    ).tolist()
    return index[:3]


def _expected_error(spread_mm: float, spacing_mm: tuple[float, float, float], residual_mm: float) -> float:
    """From the rule's own spread along each axis, a quarter of a voxel's, and what a head is off a sphere."""
    voxel = sum(s**2 for s in spacing_mm) / 16
    return math.sqrt(3 * spread_mm**2 + voxel + (residual_mm / 2) ** 2)
