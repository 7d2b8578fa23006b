"""Closed surfaces of the bones of one hip, from a file."""

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import trimesh
from numpy.typing import NDArray

from femoreg_torch.errors import InputError
from femoreg_torch.volume import check_closed

Points = NDArray[np.float64]

BONES = ("hip_left", "hip_right", "sacrum", "femur_left", "femur_right")
_ABOUT = ("source", "licence", "role")


@dataclass(frozen=True, eq=False)
class BoneSurfaces:
    """Bones of one subject, in LPS mm, and what may be done with them."""

    name: str
    bones: dict[str, trimesh.Trimesh]  # those of BONES, vertices float64
    source: str
    licence: str
    role: str


def read_surfaces(path: Path) -> BoneSurfaces:
    """Surfaces from an `.npz` file with `BONE_vertices` (V, 3) in LPS mm and `BONE_faces` (F, 3) of the five bones.

    The texts `source`, `licence` and `role` in it are kept. Raises `InputError` for a file that is missing or lacks
    something, and for an open surface.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    try:
        with np.load(path) as content:
            arrays = {name: content[name] for name in content.files}
    except (BadZipFile, ValueError, OSError) as error:
        raise InputError(f"{path}: cannot be read as a NumPy archive (.npz).") from error
    for name in (f"{bone}_{part}" for bone in BONES for part in ("vertices", "faces")):
        if name not in arrays or arrays[name].ndim != 2 or arrays[name].shape[1] != 3:
            raise InputError(f"{path}: an array `{name}` of shape (N, 3) was expected.")
    bones = {
        bone: check_closed(
            trimesh.Trimesh(arrays[f"{bone}_vertices"].astype(float), arrays[f"{bone}_faces"], process=False),
            f"{path}, {bone}",
        )
        for bone in BONES
    }
    return BoneSurfaces(path.stem, bones, *(str(arrays.get(name, "unknown")) for name in _ABOUT))
