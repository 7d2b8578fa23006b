"""Where a model ends along its guide, against the tip that is told of it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.geometry import transform_points
from femoreg_torch.volume.grid import Volume

_SOLID = 0.004  # 1/mm: a fifth of water
_AROUND_MM = 6.0  # of the guide's line: thinner than most handles and arms beside it
_LOOKED_AT_MM = -40.0, 15.0  # along the guide from the tip: a drill may stand out of a sleeve whose model lacks it
_END_MM = 8.0  # of the model: the slanted end of a needle is shorter, and its tip lies on one side
_DIRECTIONS = 72
_SLICES_MM, _SLICE_MM = (-40, -8, 4), 4.0  # whose middles tell the axis: not those of a slanted or pointed end
_SLENDER_MM = 8.0  # of the radius of these: a plate or a handle has no axis that the guide must be
_STRAIGHT_MM = 0.4  # of these middles from one line
_WIDEST_MM = 15.0  # from the guide's line: a plate or a handle is no end of a guide


@dataclass(frozen=True)
class GuideEnd:
    """How the tip that is told lies to the end of the model."""

    beyond_mm: float  # of the tip, along the guide, past the last of the model; negative: before it
    off_middle_mm: float  # of the guide's line, from the middle of the model's last 8 mm
    aside_mm: float  # of the guide's line, beside all that these 8 mm hold; 0 where the line runs through them
    leaning_deg: float  # of the guide's line, from the axis of the model's last 40 mm; nan where these have no axis


def guide_end(volume: Volume, base: Tensor, tip: Tensor) -> GuideEnd | None:
    """The end of a model's attenuation (1/mm) near its guide, which runs from `base` (3,) to `tip` (3,), mm.

    What lies within 6 mm of the guide's line counts, up to 40 mm before the tip. None if nothing does.
    """
    axis = (tip - base).double() / (tip - base).norm()
    filled = (volume.data > _SOLID).nonzero().flip(1).double().cpu()
    places = transform_points(volume.lps_from_index, filled) - tip
    along = places @ axis
    near = (along > _LOOKED_AT_MM[0]) & (along < _LOOKED_AT_MM[1])
    across = torch.linalg.svd(axis[None])[2][1:]  # (2, 3), at right angles to the guide
    along, aside = along[near], places[near] @ across.T
    around = aside.norm(dim=1) < _AROUND_MM
    if not around.any():
        return None
    half_mm = max(volume.spacing_mm) / 2  # of a voxel about its centre
    last = float(along[around].max())
    end = aside[(along > last - _END_MM) & (along <= last)]
    beside = end[end.norm(dim=1) < _AROUND_MM]
    turns = torch.arange(_DIRECTIONS, dtype=torch.float64) * (2 * math.pi / _DIRECTIONS)
    directions = torch.stack([turns.cos(), turns.sin()], 1)
    gap = float((beside @ directions.T).amin(0).max())  # to the convex hull of what the end holds
    middle = _whole(end, beside, 4 * half_mm).mean(0)  # no gaps within a piece
    leaning = _leaning_deg(along - last, aside, 4 * half_mm)
    return GuideEnd(-(last + half_mm), float(middle.norm()), max(0.0, gap - half_mm), leaning)


def _leaning_deg(before: Tensor, aside: Tensor, cell_mm: float) -> float:
    """The angle between the guide's line and the model's axis there, of places by mm `before` (N,) and `aside` (N, 2).

    The axis is the straight line through the middles of cross-sections that are slender and all round about one line;
    nan where there is none, as beside a handle.
    """
    steps, middles = [], []
    for start in range(*_SLICES_MM):
        slab = aside[(before > start) & (before <= start + _SLICE_MM)]
        beside = slab[slab.norm(dim=1) < _AROUND_MM]
        if not len(beside):
            return math.nan
        piece = _whole(slab, beside, cell_mm)
        middle = (piece.amin(0) + piece.amax(0)) / 2
        if float((piece - middle).norm(dim=1).max()) > _SLENDER_MM:
            return math.nan
        steps.append(start + _SLICE_MM / 2)
        middles.append(middle)
    found = torch.stack(middles)
    terms = torch.stack([torch.ones(len(steps)), torch.tensor(steps)], 1).to(found)
    fit = torch.linalg.lstsq(terms, found).solution
    off = float((found - terms @ fit).norm(dim=1).max())
    return math.degrees(math.atan(float(fit[1].norm()))) if off < _STRAIGHT_MM else math.nan


def _whole(end: Tensor, beside: Tensor, cell_mm: float) -> Tensor:
    """Of places (N, 2) across the guide, all of one piece with those `beside` its line; these alone of a wide piece.

    A thick sleeve of which the line leaves the middle lies near it in part alone.
    """
    end = end[end.norm(dim=1) < _WIDEST_MM]
    cells = (end / cell_mm).round().long()
    first = cells.amin(0)
    filled = np.zeros((cells.amax(0) - first + 1).tolist(), bool)
    filled[tuple((cells - first).T.numpy())] = True
    pieces = ndimage.label(filled, np.ones((3, 3)))[0]
    of = pieces[tuple((cells - first).T.numpy())]
    wanted = pieces[tuple(((beside / cell_mm).round().long() - first).T.numpy())]
    whole = end[torch.from_numpy(np.isin(of, wanted))]
    return beside if float(whole.norm(dim=1).max()) > _WIDEST_MM - cell_mm else whole
