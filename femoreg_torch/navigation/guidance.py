"""The guide of a tool against the planned path, and the smallest motion of the tool that brings it there."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.case import Result
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3, invert_rigid, rigid, transform_points


@dataclass(frozen=True, eq=False)
class Guidance:
    """Guide and plan as registered. Points and unit directions are (3,), float64, in the tool's frame (CAD, mm)."""

    object: str  # the object with the planned path
    tool: str  # the object with the guide
    object_from_tool: Tensor  # (4, 4)
    entry_point: Tensor
    tip: Tensor
    path: Tensor  # from the entry point to the target
    guide: Tensor  # from the base to the tip

    @property
    def tip_offset(self) -> Tensor:
        """Tip minus entry point (3,), mm, in the tool's frame."""
        return self.tip - self.entry_point

    @property
    def angle_deg(self) -> float:
        """Angle between guide and planned path, 0 to 180°; atan2 stays exact for small angles."""
        return math.degrees(_angle(self.guide, self.path))

    @property
    def correction(self) -> Tensor:
        """The motion (4, 4) of the tool, in its frame as registered, after which it stands as planned.

        A point x of the tool moves to `correction @ x`, so that
        `object_from_tool @ correction` is the pose to reach. The guide comes to lie on the planned path with its tip
        at the entry point. That leaves the turn about the guide free; of all rotations that take one direction to
        another, that about their common normal is the smallest, and it is the one taken.
        """
        rotation = _smallest_rotation(self.guide, self.path)
        return rigid(rotation, self.entry_point - rotation @ self.tip)


def guide(result: Result) -> Guidance:
    """Guide and plan of a result. Raises `InputError` if no tool, or no planned path, was registered."""
    name, tool = result.path or (None, None)
    object_from_tool = result.object_from_tool
    if name is None or tool is None or object_from_tool is None:
        raise InputError("no tool was registered, so there is nothing to steer. Give images of it for every view.")
    for where, known, keys in (
        ("points_camera1", result.points_camera1, ("entry_point", "tip")),
        ("directions_camera1", result.directions_camera1, ("path", "guide")),
    ):
        for key in keys:
            if key not in known:
                raise InputError(f"{where}.{key}: missing from the result. Register again.")
    tool_from_camera1 = invert_rigid(result.poses.camera1_from[tool])
    points = torch.stack([result.points_camera1["entry_point"], result.points_camera1["tip"]])
    entry_point, tip = transform_points(tool_from_camera1, points)
    path, axis = (tool_from_camera1[:3, :3] @ result.directions_camera1[key] for key in ("path", "guide"))
    return Guidance(name, tool, object_from_tool, entry_point, tip, path / path.norm(), axis / axis.norm())


def untold_turn(result: Result, found: Guidance) -> str | None:
    """That no image tells the turn of a tool about its long axis, and what that leaves open, in words; or None.

    It is round, or what is in view of it is. That what is told in the frame of the object holds all the same is said
    of a result that is trusted, and of no other.
    """
    quality = result.quality.get(found.tool)
    if quality is None or quality.turn_told:
        return None
    untold = (
        f"no image tells the turn of the {found.tool} about its long axis: directions in its frame, or in the robot's "
        "base, may be turned about it"
    )
    return f"{untold}; those in the frame of the {found.object} hold" if result.verdict.trusted else untold


def _angle(a: Tensor, b: Tensor) -> float:
    return torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).item()


def _smallest_rotation(a: Tensor, b: Tensor) -> Tensor:
    """The rotation (3, 3) of the smallest angle that takes one unit vector (3,) to another.

    Opposite directions have no common normal: the turn is then about a direction square to both.
    """
    normal = torch.linalg.cross(a, b)
    if normal.norm() < 1e-9:
        if a @ b > 0:
            return torch.eye(3, dtype=a.dtype)
        normal = torch.linalg.cross(a, torch.eye(3, dtype=a.dtype)[a.abs().argmin()])
    return exp_so3(normal / normal.norm() * _angle(a, b))
