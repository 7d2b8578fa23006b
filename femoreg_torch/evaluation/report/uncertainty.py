"""How uncertain the offset of the guide's tip and the angle of the guide are, from what a result tells of its poses."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.case import Result
from femoreg_torch.geometry import transform_points


@dataclass(frozen=True)
class GuideUncertainty:
    """Standard deviations."""

    tip_mm: float  # of the tip from the entry point, along the direction in which it is least certain
    angle_deg: float  # of the guide against the path, about the axis square to the guide that is least certain


def guide_uncertainty(result: Result, reference_points: dict[str, Tensor]) -> GuideUncertainty | None:
    """Uncertainty of tip and angle, from the deviations of both poses; None where the result does not tell them.

    `reference_points` (3,) are those of the objects, mm in their own space, at which the deviations are told. A point x
    of an object with reference point c moves by t + w × (x − c). A result holds the standard deviations of t and w
    alone (along and about the axes of camera 1), so these are taken as independent, and so are the two objects. Errors
    in depth that both share are thereby counted as if they were not shared.
    """
    name, tool = result.path or (None, None)
    points, guide = result.points_camera1, result.directions_camera1.get("guide")
    if name is None or tool is None or guide is None or not {"entry_point", "tip"} <= set(points):
        return None
    spread, turn = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    for thing, point in ((name, points["entry_point"]), (tool, points["tip"])):
        quality, pose = result.quality.get(thing), result.poses.camera1_from.get(thing)
        if quality is None or pose is None or thing not in reference_points:
            return None
        deviations = (*quality.rotation_deviation_deg, *quality.translation_deviation_mm)
        if len(deviations) != 6 or not all(map(math.isfinite, deviations)):
            return None
        values = torch.tensor(deviations, dtype=torch.float64)
        rotation, translation = values[:3].deg2rad().square().diag(), values[3:].square().diag()
        lever = _cross_matrix(point - transform_points(pose, reference_points[thing][None])[0])
        spread += translation + lever @ rotation @ lever.T
        turn += rotation
    square = torch.eye(3, dtype=torch.float64) - guide[:, None] * guide  # a turn about the guide does not tilt it
    return GuideUncertainty(_largest(spread), math.degrees(_largest(square @ turn @ square)))


def _largest(covariance: Tensor) -> float:
    """The standard deviation along the direction in which it is largest."""
    return math.sqrt(max(float(torch.linalg.eigvalsh(covariance)[-1]), 0.0))


def _cross_matrix(r: Tensor) -> Tensor:
    """The matrix (3, 3) of w ↦ w × r, up to its sign."""
    x, y, z = r.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
