"""Closed surfaces of the bones of one hip, from a file."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from femoreg_torch.errors import InputError, in_mm
from femoreg_torch.paths import check_readable
from femoreg_torch.volume import check_closed

Points = NDArray[np.float64]

BONES = ("hip_left", "hip_right", "sacrum", "femur_left", "femur_right")
_MOST_BYTES = 2**30
_SHORTEST_MM, _LONGEST_MM = 20.0, 700.0  # of a hip bone, sacrum or femur along any axis
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
    check_readable(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
                raise InputError(f"{path}: unpacks to more than {_MOST_BYTES / 2**20:g} MB, which no surfaces have.")
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except InputError:
        raise
    except Exception as error:  # of zip, zlib or NumPy, by where the file is damaged
        raise InputError(f"{path}: cannot be read as a NumPy archive (.npz).") from error
    for bone in BONES:
        for name, kinds in ((f"{bone}_vertices", "fiu"), (f"{bone}_faces", "iu")):
            found = arrays.get(name)
            if found is None or found.ndim != 2 or found.shape[1] != 3 or found.dtype.kind not in kinds:
                raise InputError(f"{path}: an array `{name}` of shape (N, 3) was expected.")
        faces, count = arrays[f"{bone}_faces"], len(arrays[f"{bone}_vertices"])
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            raise InputError(f"{path}: `{bone}_faces` names a corner that is not among the vertices.")
        for axis, extent in enumerate(np.ptp(arrays[f"{bone}_vertices"], axis=0) if count else (0, 0, 0)):
            if not _SHORTEST_MM <= extent <= _LONGEST_MM:
                raise InputError(
                    f"{path}: `{bone}_vertices` span {in_mm(extent)} along {'xyz'[axis]}, but {_SHORTEST_MM:g} to "
                    f"{_LONGEST_MM:g} mm were expected. Are they in mm?"
                )
    bones = {
        bone: check_closed(
            trimesh.Trimesh(arrays[f"{bone}_vertices"].astype(float), arrays[f"{bone}_faces"], process=False),
            f"{path}, {bone}",
        )
        for bone in BONES
    }
    return BoneSurfaces(path.stem, bones, *(str(arrays.get(name, "unknown")) for name in _ABOUT))
