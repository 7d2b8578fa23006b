"""Where the border of a volume cuts what is inside."""

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from femoreg_torch.volume.grid import Volume

FACES = ("right", "left", "front", "back", "lower", "upper")  # low and high end of x, y, z


def cut_bones(labels: Volume, ids: Mapping[str, int], bones: Sequence[str]) -> list[str]:
    """In words, which of these bones the border of the volume cuts where it should not.

    A shaft that is cut below, and vertebrae above, are as usual.
    """
    told = []
    for name in bones:
        if name not in ids:
            continue
        faces = touched_faces(labels.data == ids[name], least_mm2=20.0, spacing=labels.spacing_mm)
        usual = {"lower"} if name.startswith("femur") else {"upper"} if name in ("vertebrae", "sacrum") else set()
        if cut := [face for face in faces if face not in usual]:
            told.append(f"{name} is cut at the {' and '.join(cut)} face of the volume")
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
