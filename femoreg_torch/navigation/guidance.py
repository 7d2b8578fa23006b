"""The guide against the planned path, and the smallest motion of the device that brings it there."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3, invert_rigid, rigid, transform_points


@dataclass(frozen=True, eq=False)
class Guidance:
    """Guide and plan as registered. Points and unit directions are (3,), float64, in the device's frame (CAD, mm)."""

    femur_from_device: Tensor  # (4, 4)
    entry_point: Tensor
    tip: Tensor
    path: Tensor  # from the entry point to the target
    guide: Tensor  # from the base to the tip

    @property
    def tip_offset(self) -> Tensor:
        """Tip minus entry point (3,), mm, in the device's frame."""
        return self.tip - self.entry_point

    @property
    def angle_deg(self) -> float:
        """Angle between guide and planned path, 0 to 180°; atan2 stays exact for small angles."""
        return math.degrees(_angle(self.guide, self.path))

    @property
    def correction(self) -> Tensor:
        """The motion (4, 4) of the device, in its frame as registered, after which it stands as planned.

        A point x of the device moves to `correction @ x`, so that
        `femur_from_device @ correction` is the pose to reach. The guide comes to lie on the planned path with its tip
        at the entry point. That leaves the turn about the guide free; of all rotations that take one direction to
        another, that about their common normal is the smallest, and it is the one taken.
        """
        rotation = _smallest_rotation(self.guide, self.path)
        return rigid(rotation, self.entry_point - rotation @ self.tip)


def guide(result: dict[str, Any]) -> Guidance:
    """Guide and plan from the content of a result, with tensors as `read_result` gives them.

    Raises `InputError` if no device was registered.
    """
    if "camera1_from_device" not in result:
        raise InputError("no device was registered, so there is nothing to steer. Give device images for every view.")
    device_from_camera1 = invert_rigid(result["camera1_from_device"])
    points, directions = result["points_camera1"], result["directions_camera1"]
    entry_point, tip = transform_points(device_from_camera1, torch.stack([points["entry_point"], points["tip"]]))
    path, axis = (device_from_camera1[:3, :3] @ directions[name] for name in ("path", "guide"))
    femur_from_device = invert_rigid(result["camera1_from_femur"]) @ result["camera1_from_device"]
    return Guidance(femur_from_device, entry_point, tip, path / path.norm(), axis / axis.norm())


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
