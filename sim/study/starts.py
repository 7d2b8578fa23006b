"""Start poses at a stated distance from the truth."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.geometry import about_point, exp_so3, rigid, transform_points
from femoreg_torch.settings import check_within


@dataclass(frozen=True)
class Offset:
    """How far a start lies from the truth."""

    rotation_deg: float
    depth_mm: float
    lateral_mm: float

    def __post_init__(self) -> None:
        check_within(self, rotation_deg=(-180, 180), depth_mm=(-2000, 2000), lateral_mm=(-1000, 1000))


def displaced(camera1_from_pelvis: Tensor, centre: Tensor, by: Offset, generator: torch.Generator) -> Tensor:
    """A start pose (4, 4): turned about `centre` (3,) of the pelvis (mm, LPS) and shifted, in camera axes.

    The axis of rotation is uniform on the sphere, the shift's direction uniform in the image plane, the change of depth
    as often towards the source as away from it.
    """
    axis = F.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    angle, sign = torch.rand(2, generator=generator, dtype=torch.float64)
    along = 2 * torch.pi * angle
    depth = by.depth_mm * (1.0 if sign < 0.5 else -1.0)
    shift = torch.stack([by.lateral_mm * along.cos(), by.lateral_mm * along.sin(), torch.as_tensor(depth).double()])
    turn = rigid(exp_so3(torch.deg2rad(torch.tensor(by.rotation_deg, dtype=torch.float64)) * axis))
    middle = transform_points(camera1_from_pelvis, centre[None])[0]
    return rigid(translation=shift) @ about_point(turn, middle) @ camera1_from_pelvis
