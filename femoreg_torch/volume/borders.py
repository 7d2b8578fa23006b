"""Where the border of a volume, or its round field, cuts what is inside."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.round_field import RoundField

FACES = ("right", "left", "front", "back", "lower", "upper")  # low and high end of x, y, z
_LEAST_MM2 = 20.0  # of a bone at a border


def cut_bones(
    labels: Volume, ids: Mapping[str, int], bones: Sequence[str], field: RoundField | None = None
) -> list[str]:
    """In words, which of these bones the border of the volume, or the CT's round `field`, cuts where it should not.

    A shaft that is cut below, and vertebrae above, are as usual.
    """
    told = []
    for name in bones:
        if name not in ids:
            continue
        inside = labels.data == ids[name]
        faces = touched_faces(inside, least_mm2=_LEAST_MM2, spacing=labels.spacing_mm)
        usual = {"lower"} if name.startswith("femur") else {"upper"} if name in ("vertebrae", "sacrum") else set()
        if cut := [face for face in faces if face not in usual]:
            told.append(f"{name} is cut at the {' and '.join(cut)} face of the volume")
        if field is not None and _at_the_edge_mm2(inside, field, labels.spacing_mm) >= _LEAST_MM2:
            told.append(f"{name} is cut by the round field of the CT")
    return told


def touched_faces(inside: Tensor, least_mm2: float, spacing: tuple[float, float, float]) -> list[str]:
    """Faces of the volume where what is inside (Z, Y, X), bool, has at least that area."""
    found = []
    for axis in range(3):
        area = float(np.prod([s for k, s in enumerate(spacing) if k != axis]))
        for end in (0, -1):
            if float(inside.select(2 - axis, end).sum()) * area >= least_mm2:
                found.append(FACES[2 * axis + (end != 0)])
    return found


def _at_the_edge_mm2(inside: Tensor, field: RoundField, spacing: tuple[float, float, float]) -> float:
    """Area of what is inside (Z, Y, X), bool, at the edge of a round field: of its outermost layer of voxels."""
    x, y, z = spacing
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in inside.shape[1:])
    within = field.within_mm(columns * x, rows[:, None] * y)
    layer = (within >= 0) & (within < max(x, y))
    return float((inside & layer).sum()) * min(x, y) * z
