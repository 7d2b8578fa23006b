"""The C-arm's intrinsics as degrees of freedom: one source distance for all views, a principal point for each."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.geometry import CameraChange
from femoreg_torch.optimize import Quadratic, profile

# The penalty that a deviation of one standard deviation adds to the mean patch NCC is half of this. Near a solution the
# mean patch NCC behaves like a log-likelihood times 2e-5 (R / S of `registration.evidence.covariance` over development
# cases), so that the file's word weighs as much as it is worth against images, and counts where they say nothing.
PRIOR_WEIGHT = 2e-5

# What the images' own deviations do not tell: soft tissue, scatter and a device that are drawn a little wrong look like
# another source distance or principal point. By the root mean squares of steps of Newton and of their deviations, five
# development cases whose C-arm is right asked for so much more: 0.25 % (anatomy alone, less well drawn: 0.29 %) and, of
# all views together, 2.3 mm (3.7 mm). Views by themselves asked for up to 14 mm.
_MISFIT_SDD = 0.0025
_MISFIT_MM = 3.0

# Of the C-arm's file, what is doubted by itself.
DISTANCE, POINTS = "source distance", "principal points"


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """What moves beside the bodies where the cameras are refined.

    A delta holds the logarithm of the source distance, then x and y of the principal point of every view, in units of
    `scale` (1 + 2 V,), the standard deviations of the C-arm's file: 1 and mm on the detector. Those of scale zero stay
    as they are. `offset` (1 + 2 V,) is how far the cameras lie from the file already, 1 and mm.

    With them the C-arm of every view slides before the named `objects`, so that something at `reach` (V,), its depth by
    the source distance, stays where it is seen and as large as it is seen: what remains is the change of perspective. A
    search without this coupling creeps along a narrow valley. Zeros where the C-arm's poses are known and stay.
    """

    objects: tuple[str, ...]  # what is drawn; what has not been looked for yet stays where it is expected
    scale: Tensor
    offset: Tensor
    reach: Tensor
    sdd_mm: float  # before

    @property
    def free(self) -> Tensor:
        """Indices (n,) of the degrees of freedom that move."""
        return self.scale.nonzero()[:, 0]

    @property
    def units_off(self) -> Tensor:
        """How far the free ones lie from the C-arm's file, (n,), in standard deviations."""
        return (self.offset / self.scale)[self.free]

    def only(self, parts: Collection[str]) -> "Intrinsics":
        """The same with nothing free but `DISTANCE` or `POINTS`."""
        scale = self.scale.clone()
        scale[:1] *= DISTANCE in parts
        scale[1:] *= POINTS in parts
        return replace(self, scale=scale)

    def changes(self, delta: Tensor) -> tuple[CameraChange, ...]:
        """How the camera of every view changes with a delta (n,)."""
        values = torch.zeros_like(self.scale)
        values[self.free] = delta * self.scale[self.free]
        factor = math.exp(float(values[0]))
        return tuple(CameraChange(factor, (x, y)) for x, y in values[1:].view(-1, 2).tolist())

    def slides(self, deltas: Tensor) -> Tensor:
        """Motions (P, V, 4, 4) of the objects in the camera of each view for deltas (P, n)."""
        values = deltas.new_zeros(len(deltas), len(self.scale))
        values[:, self.free] = deltas * self.scale[self.free]
        motions = torch.eye(4, dtype=deltas.dtype).repeat(len(deltas), len(self.reach), 1, 1)
        motions[..., :2, 3] = -values[:, 1:].view(len(deltas), -1, 2) * self.reach[:, None]
        motions[..., 2, 3] = values[:, :1].expm1() * self.sdd_mm * self.reach
        return motions

    def slide_rates(self, view: int, sdd_mm: float | None = None) -> Tensor:
        """How fast the objects slide in the camera of a view, (3, 3) mm, by each of its intrinsics.

        The intrinsics are log source distance and principal point (mm); `sdd_mm` is the distance now, if not `self`'s.
        """
        return self.reach[view] * torch.diag(self.reach.new_tensor([-1.0, -1.0, sdd_mm or self.sdd_mm]))[[2, 0, 1]]

    def by_delta(self, view: int) -> Tensor:
        """Derivatives (3, n) of a view's log source distance and principal point (mm) by the delta."""
        rows = self.scale.diag()[[0, 1 + 2 * view, 2 + 2 * view]]
        return rows[:, self.free]


def refined(changes: Sequence[CameraChange]) -> frozenset[str]:
    """Which parts of the C-arm's file cameras that changed so no longer have: `DISTANCE`, `POINTS`."""
    distance = any(change.sdd_factor != 1 for change in changes)
    points = any(shift != 0 for change in changes for shift in change.principal_point_shift_mm)
    return frozenset([DISTANCE] * distance + [POINTS] * points)


def doubted(model: Quadratic, intrinsics: Intrinsics, least: float) -> frozenset[str]:
    """What images doubt by so many standard deviations, and what is to be refined for that: `DISTANCE`, `POINTS`.

    A distance that is doubted lets the principal points go too. Points that are leave the distance as it is, if the
    images do not doubt that as well: it would take everything with it into the depth.
    """
    found = doubts(model, intrinsics)
    if found[DISTANCE] >= least:
        return frozenset([DISTANCE, POINTS])
    return frozenset([POINTS] if found[POINTS] >= least else [])


def doubts(model: Quadratic, intrinsics: Intrinsics) -> dict[str, float]:
    """By how many standard deviations the images doubt the C-arm's file: its `DISTANCE`, and its `POINTS`.

    It says three things: a source distance, and x and y of a principal point, for all views alike, so that its mistakes
    are the same in all. A single view that asks for a principal point of its own asks for sag, or for what is drawn a
    little wrong, which is no reason to let them go. Of x and y the more doubtful counts.
    A step of Newton along each by itself, the bodies refitted, is compared with its deviation: that of the sandwich
    estimator over tiles, and what images that are drawn a little wrong feign.
    """
    found = profile(model, len(intrinsics.free))
    ways = torch.zeros(len(intrinsics.scale), 3, dtype=torch.float64)
    ways[0, 0] = ways[1::2, 1] = ways[2::2, 2] = 1.0
    ways = (ways / intrinsics.scale[:, None])[intrinsics.free]  # (n, 3): how a delta changes them by 1, and by 1 mm
    misfit = ways.new_tensor([_MISFIT_SDD, _MISFIT_MM, _MISFIT_MM])
    scores = found.scores @ ways
    feigned = (ways * (found.curvature @ ways)).sum(0) * misfit
    deviation = (scores.square().sum(0) + feigned.square()).sqrt()
    free = ways.any(0)
    distance, x, y = torch.where(free, scores.sum(0).abs() / deviation, torch.zeros_like(deviation)).tolist()
    return {DISTANCE: distance, POINTS: max(x, y)}
