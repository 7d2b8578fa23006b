"""How uncertain the offset of the guide's tip and the angle of the guide are, from what a result tells of them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.case import Result
from femoreg_torch.geometry.rigid import skew


@dataclass(frozen=True)
class GuideUncertainty:
    """Standard deviations."""

    tip_mm: float  # of the tip from the entry point, along the direction in which it is least certain
    angle_deg: float  # of the guide against the path, about the axis square to the guide that is least certain


def guide_uncertainty(result: Result) -> GuideUncertainty | None:
    """Uncertainty of tip and angle, from the result's `path_covariance`; None where the result does not tell it.

    By that covariance a point of the tool at r from the entry point moves by t + w × r in the object with the path. So
    what both objects share, such as an error in depth, is not counted.
    """
    points, guide = result.points_camera1, result.directions_camera1.get("guide")
    if result.path is None or guide is None or not {"entry_point", "tip"} <= set(points):
        return None
    if result.path_covariance is None or not torch.isfinite(result.path_covariance).all():
        return None
    object_from_camera1 = result.poses.camera1_from[result.path[0]][:3, :3].T
    in_radians = torch.tensor([1.0] * 3 + [math.pi / 180] * 3, dtype=torch.float64)
    covariance = in_radians[:, None] * result.path_covariance * in_radians
    lever = object_from_camera1 @ (points["tip"] - points["entry_point"])
    moves = torch.cat([torch.eye(3, dtype=torch.float64), -skew(lever)], dim=1)
    along = object_from_camera1 @ guide
    square = torch.eye(3, dtype=torch.float64) - along[:, None] * along  # a turn about the guide does not tilt it
    tilt = square @ covariance[3:, 3:] @ square
    return GuideUncertainty(_largest(moves @ covariance @ moves.T), math.degrees(_largest(tilt)))


def _largest(covariance: Tensor) -> float:
    """The standard deviation along the direction in which it is largest."""
    return math.sqrt(max(float(torch.linalg.eigvalsh(covariance)[-1]), 0.0))
