"""How the errors that studies tell change with the poses, to first order."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from femoreg_torch.evaluation import ReferencePoints
from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.statistics.quantities import AXES

_DEG = 180 / math.pi


def view_block(view: int) -> str:
    """The name of the unknown pose of the C-arm in a view (from 0), as in tables."""
    return f"view{view + 1}"


def centres_in(poses: Poses, points: ReferencePoints, view: int) -> dict[str, Tensor]:
    """Reference points (3,) of all objects, mm in the camera of a view (from 0): what their twists turn about."""
    return {
        name: transform_points(poses.camera_from(name)[view], points.objects[name][None])[0]
        for name in poses.camera1_from
    }


def error_responses(poses: Poses, points: ReferencePoints) -> dict[str, dict[str, Tensor]]:
    """How every column of `femoreg_torch.statistics.quantities` changes with the twists of poses, (r, 6) of each.

    Twists (rad, mm) of objects act along the axes of camera 1 about their reference points, those of the C-arm of view
    k along the axes of its camera about that of the first object. Lengths and angles of `errors` (equations 5 to 13 of
    the paper) are the lengths of the r numbers; signed columns have r = 1.
    """
    here = centres_in(poses, points, 0)
    found: dict[str, dict[str, Tensor]] = {}
    middle, axes = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    for name in here:
        found |= _of_pose(name, name, _moves(middle), _turns(axes), points.paper_from_camera)
    anchor = next(iter(poses.camera1_from))
    for view in range(1, len(poses.camera_from_camera1)):
        back = -poses.camera_from_camera1[view, :3, :3].T  # the camera moves against what it sees
        shift, turn = back @ _moves(-centres_in(poses, points, view)[anchor]), back @ _turns(axes)
        found |= _of_pose(view_block(view), view_block(view), shift, turn, points.paper_from_camera)
    return found | _of_path(poses, points, here)


def _of_path(poses: Poses, points: ReferencePoints, here: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    plan = points.plan
    if plan is None or plan.object not in here:
        return {}
    bone = plan.object
    pose = poses.camera1_from[bone]
    entry = {bone: _moves(transform_points(pose, plan.entry_point[None])[0] - here[bone])}
    found = {"entry_point_mm": entry, "path_deg": {bone: _tilt(pose, plan.target - plan.entry_point)}}
    if plan.tool is None or plan.tool not in here or points.guide is None:
        return found
    tool, (base, end) = plan.tool, points.guide
    pose = poses.camera1_from[tool]
    tip = {tool: _moves(transform_points(pose, end[None])[0] - here[tool])}
    relative = {bone: entry[bone], tool: -tip[tool]}
    return found | {"tip_mm": tip, "relative_mm": relative, "guide_deg": {tool: _tilt(pose, end - base)}}


def _of_pose(
    key: str, block: str, shift: Tensor, turn: Tensor, paper_from_camera: Tensor
) -> dict[str, dict[str, Tensor]]:
    """Totals and signed parts of displacements (3, 6) and turns (3, 6) in camera 1."""
    found = {}
    for unit, rows in (("mm", shift), ("deg", turn)):
        told = paper_from_camera @ rows
        found[f"{key}_{unit}"] = {block: told}
        found |= {f"{key}_{unit}_{axis}": {block: told[n : n + 1]} for n, axis in enumerate(AXES)}
    return found


def _moves(arm: Tensor) -> Tensor:
    """Displacement (3, 6) of a point that lies at `arm` (3,) mm from the centre of a twist: t + ω × arm."""
    return torch.cat([-skew(arm), torch.eye(3, dtype=torch.float64)], 1)


def _turns(axes: Tensor) -> Tensor:
    return torch.cat([_DEG * axes, torch.zeros(3, 3, dtype=torch.float64)], 1)


def _tilt(pose: Tensor, direction: Tensor) -> Tensor:
    """Change (3, 6) in degrees of a direction (3,) of an object: ω × d, d of length 1 in camera 1."""
    turned = pose[:3, :3] @ direction
    return _turns(-skew(turned / turned.norm()))
