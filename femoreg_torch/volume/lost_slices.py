"""Does a CT lack a slice that nothing in its header tells of?

From slice to slice the outlines of bone and skin move on by about as much. Where one is missing they move twice as far
at once. So the change across each gap is compared with the mean of the changes across the gaps before and behind it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.labels import label_box

_HU = -200, 1000  # what moves on: bone and skin, and not metal or air
_PIXEL_MM, _SMOOTH_PX = 2.0, 3  # grey values are averaged over so many of such pixels, along both axes
_BLOCK_MM = 24.0  # what is looked at by itself
_BESIDE_MM = 40.0  # of the bones
_LEAST_SLICES = 6  # for three gaps that have one on either side
_LEAST_CHANGE_HU = 15.0  # of a block, for it to count; noise of thick pixels is less
_LEAST_BLOCKS = 16  # that count at a gap and at its neighbours
_SHARE = 0.25  # of the blocks that may tell less: bones end somewhere at once, but not everywhere
_LEAST_STEADY = 0.4  # of the changes beside those before and behind, in the median of gaps: else noise hides them
# Of the change across a gap: how much more than at its neighbours, and than in the median by which factor. Of 71 right
# CTs of six makes at most 0.60 and 1.6, or 0.77 and 1.06. Of 11 that lacked one to four slices, seven: 0.86 and 1.8 to
# 2.4 and 3.8. One that lacked a slice of 1.25 mm: 0.62 and 1.5.
_LEAST_MORE, _LEAST_FACTOR = 0.75, 1.5


def lost_slice(ct: Volume, labels: Volume, ids: Sequence[int]) -> int | None:
    """The slice (from 0) of a CT, HU, after which the anatomy goes on as if one or more were missing, or None.

    Looked for in the box of the bones of these ids, of a label map on the grid of the CT, and 40 mm about it.
    """
    low, high = label_box(labels, ids)
    margin = [math.ceil(_BESIDE_MM / s) for s in ct.spacing_mm]
    x, y, z = (
        slice(max(a - m, 0), min(b + m, n))
        for a, b, m, n in zip(low, high, margin, reversed(ct.data.shape), strict=True)
    )
    across, down = (max(1, round(_PIXEL_MM / s)) for s in ct.spacing_mm[:2])
    near = ct.data[z, y, x].clamp(*_HU).float()
    side = [max(1, round(_BLOCK_MM / (s * n))) for s, n in zip(ct.spacing_mm[1::-1], (down, across), strict=True)]
    left = [n // by - _SMOOTH_PX + 1 for n, by in zip(near.shape[1:], (down, across), strict=True)]
    if len(near) < _LEAST_SLICES or any(n < block for n, block in zip(left, side, strict=True)):
        return None
    thick = F.avg_pool2d(F.avg_pool2d(near[:, None], (down, across)), _SMOOTH_PX, 1)[:, 0]
    found, count = _steadiness(thick, side)
    known = found[count >= _LEAST_BLOCKS]
    if not len(known) or float(known.median()) < _LEAST_STEADY:
        return None
    beside = torch.maximum(found[:-2], found[2:])
    enough = torch.minimum(torch.minimum(count[:-2], count[1:-1]), count[2:]) >= _LEAST_BLOCKS
    more = torch.where(enough, found[1:-1] - beside, -math.inf)
    more[found[1:-1] < _LEAST_FACTOR * known.median()] = -math.inf
    best = int(more.argmax())
    return best + 2 + z.start if float(more[best]) > _LEAST_MORE else None


def _steadiness(thick: Tensor, side: list[int]) -> tuple[Tensor, Tensor]:
    """Of slices (Z, Y, X) the changes across inner gaps by those beside them, and how many blocks tell it, (Z − 3,).

    What all but a quarter of the blocks of so many pixels reach: about 1 where all goes on evenly, 2 where a slice is
    missing.
    """
    change = thick.diff(dim=0)
    beside, here = (change[:-2] + change[2:]) / 2, change[1:-1]
    both, own = (F.avg_pool2d(each[:, None], side)[:, 0].flatten(1) for each in (here * beside, beside**2))
    quiet = own.flatten().kthvalue(max(1, own.numel() // 5)).values  # noise alone
    counts = own > torch.maximum(4 * quiet, torch.tensor(_LEAST_CHANGE_HU**2))
    ratio = torch.where(counts, both / own.clamp_min(1e-9), math.nan)
    return ratio.nanquantile(_SHARE, 1), counts.sum(1)


def told_of_lost_slice(ct: Volume, labels: Volume, ids: Sequence[int]) -> str | None:
    """What `lost_slice` finds, in words."""
    found = lost_slice(ct, labels, ids)
    if found is None:
        return None
    return (
        f"CT: from slice {found} to {found + 1} of {len(ct.data)} (counted from 0) bones and skin go on as if a slice "
        "were missing between them, or as if the patient had moved there: export the CT anew and count its slices"
    )
