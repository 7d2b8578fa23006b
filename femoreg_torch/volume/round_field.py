"""The round field of a CT: scanners reconstruct a circle and fill the corners of their slices with one value."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.geometry import circle_through
from femoreg_torch.volume.grid import Volume

_LEAST_EDGE = 40  # voxels of a slice along the edge; of fewer nothing is said
_OFF = 1.5  # voxels that an edge may lie off its circle
_ON_IT = 0.9  # share of the edge that does not; the outline of a body in air without noise is no circle
_REFITS = 5


@dataclass(frozen=True)
class RoundField:
    """A circle in all slices, beyond which the CT holds nothing."""

    middle_mm: tuple[float, float]  # along the x and y axes of the volume, from its first voxel
    radius_mm: float

    def within_mm(self, x_mm: Tensor, y_mm: Tensor) -> Tensor:
        """How far, mm, places along the volume's axes lie within the circle; negative beyond it. Of any one shape."""
        return self.radius_mm - torch.hypot(x_mm - self.middle_mm[0], y_mm - self.middle_mm[1])


def round_field(ct: Volume) -> RoundField | None:
    """The circle whose outside is one and the same value in all slices; None where there is none."""
    low, high = ct.data.amin(0), ct.data.amax(0)
    corners = [float(low[y, x]) for y in (0, -1) for x in (0, -1) if low[y, x] == high[y, x]]
    if not corners:
        return None
    blank = ((low == high) & (low == min(corners))).numpy()
    parts, _ = ndimage.label(blank)
    outside = np.isin(parts, [n for n in (parts[y, x] for y in (0, -1) for x in (0, -1)) if n])
    edge = ~outside & ndimage.binary_dilation(outside)
    edge[[0, -1]] = edge[:, [0, -1]] = False  # the slices end there, and the circle may go on
    places = np.argwhere(edge)[:, ::-1] * np.array(ct.spacing_mm[:2])
    if len(places) < _LEAST_EDGE:
        return None
    off_mm = _OFF * max(ct.spacing_mm[:2])
    near = np.ones(len(places), bool)
    for _ in range(_REFITS):
        (x, y), radius = circle_through(places[near])
        off = np.abs(np.hypot(*(places - (x, y)).T) - radius)
        near = off <= max(off_mm, float(np.median(off)))
    if not (off <= off_mm).mean() >= _ON_IT:
        return None
    return RoundField((float(x), float(y)), radius)
