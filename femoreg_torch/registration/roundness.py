"""Is an object round: does it look the same however it is turned about an axis of its own, as a needle or a wire does?

No image tells the turn of such an object about that axis, and where its points lie on the axis too, no place of them
depends on it. So what the images leave open of that turn says nothing against a registration. What is told in the
object's own frame depends on it all the same, see `femoreg_torch.navigation`.
"""

from collections.abc import Iterable, Sequence
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
_LEAST_INNER = 0.1  # share of the filled voxels that have filled ones on all sides; walls are thin where it is less
_MOST_OFF_MM = 1.0  # of a named point from the axis: it would turn with what no image tells
_MOST_LOPSIDED = 0.1  # of what attenuates: its middle off the axis, and its moments across it, by its spread
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


def round_axis(volume: Volume, parts: Sequence[Volume] = (), points: Iterable[Tensor] = ()) -> Axis | None:
    """The axis about which what fills a volume is round; None if there is none.

    None too if it attenuates more on one side of the axis than on the other, or one of its parts does, on the same
    grid; or if one of `points` (3,) mm lies off the axis, so that its place depends on the turn.
    """
    axis = _axis_of_what_is_filled(volume)
    if axis is None or any(_off_mm(axis, point) > _MOST_OFF_MM for point in points):
        return None
    return None if any(_lopsided(axis, solid) for solid in (volume, *parts)) else axis


def _off_mm(axis: Axis, point: Tensor) -> float:
    return float(torch.linalg.cross(axis.direction, point.double() - axis.point).norm())


def _lopsided(axis: Axis, volume: Volume) -> bool:
    """Whether what attenuates lies otherwise on one side of the axis than on another.

    Asked of its first and second moments across the axis, weighted by the attenuation.
    """
    data = volume.data.cpu().double()
    places = (data > 0).nonzero()
    if not len(places):
        return False
    weights = data[tuple(places.unbind(1))]
    weights = weights / weights.sum()
    away = transform_points(volume.lps_from_index, places.flip(1).double()) - axis.point
    across = away - (away @ axis.direction)[:, None] * axis.direction
    middle = weights @ across
    moments = torch.linalg.eigvalsh((weights[:, None] * across).T @ across)[1:]  # the smallest is along the axis
    spread = float(moments.sum().sqrt())
    least_mm = max(volume.spacing_mm) / 2  # moments of a few voxels are not known better
    off = float(middle.norm()) > max(_MOST_LOPSIDED * spread, least_mm)
    oval = float(moments[1].sqrt() - moments[0].sqrt()) > max(_MOST_LOPSIDED * spread, least_mm)
    return off or oval


def _axis_of_what_is_filled(volume: Volume) -> Axis | None:
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
        # thin walls have hardly any inner voxels: all of them must stay within a voxel of the wall
        inner, filled = places, max_pool3d(filled.float()[None, None], 3, stride=1, padding=1)[0, 0] > 0
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
