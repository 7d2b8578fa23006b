"""Is an object round: does it look the same however it is turned about an axis of its own, as a needle or a wire does?

No image tells the turn of such an object about that axis, and nothing depends on it. So what the images leave open of
that turn says nothing against a registration.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from femoreg_torch.geometry import exp_so3, transform_points
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.volume import Volume

_FILLED = 0.004  # 1/mm: a fifth of water
_TURNS_DEG = 25.0, 45.0, 70.0, 90.0, 120.0, 155.0, 180.0
_MOST_POINTS = 20_000
_LEAST_INNER = 0.1  # share of the filled voxels that have filled ones on all sides: thinner walls are not judged
_MOST_ELSEWHERE = 0.003  # share of the inner voxels that a turn may bring to where the object is not


@dataclass(frozen=True, eq=False)
class Axis:
    """Of a round object, in its own space."""

    point: Tensor  # (3,) mm
    direction: Tensor  # (3,) unit vector

    def difference(self, first: Tensor, second: Tensor) -> tuple[float, float]:
        """Degrees between the axis at two poses (4, 4), and mm between where they have the axis' point."""
        before, after = (pose[:3, :3] @ self.direction for pose in (first, second))
        angle = torch.atan2(torch.linalg.cross(before, after).norm(), before @ after)
        apart = transform_points(second, self.point[None]) - transform_points(first, self.point[None])
        return float(torch.rad2deg(angle)), float(apart.norm())

    def without_turn(self, pose: Tensor, centre: Tensor) -> Tensor:
        """(6, 6): takes a motion (degrees, mm) about `centre` (3,) to what it moves besides a turn about the axis.

        Of an object at `pose` (4, 4), along the axes of camera 1. What it gives is told about a point on the axis.
        """
        along = pose[:3, :3] @ self.direction
        arm = transform_points(pose, self.point[None])[0] - centre
        arm -= (arm @ along) * along
        rest = torch.eye(6, dtype=torch.float64)
        rest[3:, :3] = -skew(arm) * torch.pi / 180  # ω × arm
        rest[:3, :3] -= along[:, None] * along
        return rest


def round_axis(volume: Volume) -> Axis | None:
    """The axis about which what fills a volume is round; None if there is none."""
    filled = (volume.data > _FILLED).cpu()
    places = filled.nonzero()
    if len(places) < 2:
        return None
    points = transform_points(volume.lps_from_index, places.flip(1).double())
    middle = points.mean(0)
    away = points - middle
    moments, axes = torch.linalg.eigh(away.T @ away)
    inner = _inner(filled).nonzero()
    if len(inner) < _LEAST_INNER * len(places):
        return None
    core = transform_points(volume.lps_from_index, inner[:: 1 + len(inner) // _MOST_POINTS].flip(1).double())
    index_from_lps = torch.linalg.inv(volume.lps_from_index)
    direction = axes[:, 2 if moments[2] - moments[1] > moments[1] - moments[0] else 0]
    for degrees in _TURNS_DEG:
        turn = exp_so3(direction * torch.pi * degrees / 180)
        turned = transform_points(index_from_lps, (core - middle) @ turn.T + middle)
        if float(_in(filled, turned).logical_not().double().mean()) > _MOST_ELSEWHERE:
            return None
    return Axis(middle, direction)


def _inner(filled: Tensor) -> Tensor:
    """The filled voxels (Z, Y, X) all of whose 26 neighbours are filled."""
    empty = 1 - filled.float()
    return max_pool3d(empty[None, None], 3, stride=1, padding=1)[0, 0] == 0


def _in(filled: Tensor, indices: Tensor) -> Tensor:
    """Whether the voxels nearest to indices (N, 3), x first, are filled (Z, Y, X); none is beyond the grid."""
    size = torch.tensor(filled.shape[::-1])
    nearest = indices.round().long()
    there = ((nearest >= 0) & (nearest < size)).all(1)
    x, y, z = nearest.clamp_min(0).minimum(size - 1).unbind(1)
    return filled[z, y, x] & there
