"""The public DeepFluoro data set (Grupp et al., IJCARS 2020; doi 10.7281/T1/IFSXNV), both of its layouts, as they are.

Full resolution, `ipcai_2020_full_res_data.h5`: `proj-params/…` and, per specimen, `vol`, `vol-seg/image`,
`vol-landmarks` and `projections/NNN/…` with raw intensities, landmarks, poses, labels and `rot-180-for-up`.
Preprocessed, `ipcai_2020_ds_8x.h5` and so on: `land-names/…` and `NN/projs`, `segs`, `lands`, logarithms, head up.

The source stands beneath the patient, and pictures show the patient's left on the right.

Poses are read as they are stored. They were made by a renderer whose voxels lay half a voxel off (xReg ac7b473 mended
it later); its authors have not said whether that is in them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera
from femoreg_torch.neighbours.frames import XregCamera
from femoreg_torch.neighbours.xreg import entry, matrix, open_hdf5, scalar
from femoreg_torch.volume import Volume

BONES = ("hip_left", "hip_right", "vertebrae", "sacrum", "femur_left", "femur_right")  # labels 1 to 6
_OBJECTS = {"pelvis": "pelvis", "femur_left": "left-femur", "femur_right": "right-femur"}
_DEGREES = {False: 0, True: 180}


@dataclass(frozen=True, eq=False)
class Specimen:
    """One cadaver of the full-resolution file."""

    name: str
    ct: Volume  # HU
    labels: Volume  # uint8; 1 to 6 as in `BONES`, 7 the lower sacrum
    landmarks: dict[str, Tensor]  # (3,) LPS mm


@dataclass(frozen=True, eq=False)
class Picture:
    """One fluoroscopic picture as it is stored, and what is known of it."""

    specimen: str
    name: str
    image: Tensor  # (H, W) float32: raw intensities, bone dark, or logarithms, bone bright
    intensity: Literal["raw", "log"]
    camera: Camera  # of the stored picture
    display: Display
    labels: Tensor | None  # (H, W) uint8
    landmarks: dict[str, Tensor]  # (2,) column, row in the stored picture, also outside of it
    camera_from: dict[str, Tensor]  # (4, 4) of pelvis and femora, from LPS; none in preprocessed files


def is_full_resolution(path: Path) -> bool:
    """Which of the two layouts a file has. Raises `InputError` if neither."""
    with open_hdf5(path) as file:
        if "proj-params" in file:
            return True
        if "land-names" in file:
            return False
    raise InputError(f"{path}: neither layout of the DeepFluoro data set: no `proj-params` and no `land-names`.")


def specimens(path: Path) -> list[str]:
    """Names of the specimens of a full-resolution file."""
    with open_hdf5(path) as file:
        return sorted(name for name in file if name != "proj-params")


def read_specimen(path: Path, name: str) -> Specimen:
    """The CT, label map and landmarks of a specimen. Raises `InputError`."""
    with open_hdf5(path) as file:
        landmarks = {
            str(mark): matrix(file, f"{name}/vol-landmarks/{mark}", (3,), path)
            for mark in entry_group(file, f"{name}/vol-landmarks", path)
        }
        ct = _volume(file, f"{name}/vol", np.float32, path)
        labels = _volume(file, f"{name}/vol-seg/image", np.uint8, path)
    return Specimen(name, ct, labels, landmarks)


def entry_group(file: Any, name: str, path: Path) -> list[str]:
    """Names of the entries of a group. Raises `InputError` where there is none."""
    if name not in file:
        raise InputError(f"{path}: `{name}` is missing.")
    return list(file[name])


def _volume(file: Any, name: str, dtype: Any, path: Path) -> Volume:
    values = np.asarray(entry(file, f"{name}/pixels", path), dtype=dtype)
    if values.ndim != 3:
        raise InputError(f"{path}, {name}/pixels: a volume was expected, found {values.shape}.")
    affine = torch.eye(4, dtype=torch.float64)
    spacing = matrix(file, f"{name}/spacing", (3,), path)
    affine[:3, :3] = matrix(file, f"{name}/dir-mat", (3, 3), path) @ torch.diag(spacing)
    affine[:3, 3] = matrix(file, f"{name}/origin", (3,), path)
    return Volume(torch.from_numpy(values), affine)


def read_pictures(path: Path, specimen: str) -> Iterator[Picture]:
    """The pictures of a specimen of a full-resolution file, one after the other."""
    with open_hdf5(path) as file:
        carm = XregCamera(
            matrix(file, "proj-params/intrinsic", (3, 3), path),
            matrix(file, "proj-params/extrinsic", (4, 4), path),
            (int(scalar(file, "proj-params/num-rows", path)), int(scalar(file, "proj-params/num-cols", path))),
            (
                scalar(file, "proj-params/pixel-row-spacing", path),
                scalar(file, "proj-params/pixel-col-spacing", path),
            ),
        )
        for name in sorted(entry_group(file, f"{specimen}/projections", path)):
            yield _picture(file, carm, specimen, name, path)


def _picture(file: Any, carm: XregCamera, specimen: str, name: str, path: Path) -> Picture:
    group = f"{specimen}/projections/{name}"
    pixels = np.asarray(entry(file, f"{group}/image/pixels", path), dtype=np.float32)
    if pixels.shape != carm.shape:
        raise InputError(f"{path}, {group}: the image is {pixels.shape}, but `proj-params` say {carm.shape}.")
    turned = bool(scalar(file, f"{group}/rot-180-for-up", path)) if f"{group}/rot-180-for-up" in file else False
    display = Display("posterior", turned_deg=_DEGREES[turned])
    poses = {}
    for thing, told in _OBJECTS.items():
        key = f"{group}/gt-poses/cam-to-{told}-vol"
        trusted = f"{group}/gt-poses/{told}-good-fov"
        if key in file and (trusted not in file or scalar(file, trusted, path)):
            poses[thing] = carm.camera_from_lps(matrix(file, key, (4, 4), path), display)
    labels = f"{group}/gt-seg/pixels"
    if labels not in file:
        labels = f"{group}/gt-seg/image/pixels"
    marks = list(file[f"{group}/gt-landmarks"]) if f"{group}/gt-landmarks" in file else []
    return Picture(
        specimen,
        name,
        torch.from_numpy(pixels),
        "raw",
        carm.camera,
        display,
        torch.from_numpy(np.asarray(file[labels], dtype=np.uint8)) if labels in file else None,
        {str(mark): matrix(file, f"{group}/gt-landmarks/{mark}", (2,), path) for mark in marks},
        poses,
    )


def read_preprocessed(path: Path, detector: Camera, border_px: int = 50) -> Iterator[Picture]:
    """The pictures of a preprocessed file, whose every pixel is one of `detector`'s between borders that were cut off.

    Pixel u of a file that keeps every s-th one is pixel 50 + s u of the detector.
    """
    with open_hdf5(path) as file:
        count = int(scalar(file, "land-names/num-lands", path))
        names = [entry(file, f"land-names/land-{n:02d}", path)[()] for n in range(count)]
        names = [name.decode() if isinstance(name, bytes) else str(name) for name in names]
        for specimen in sorted(name for name in file if name != "land-names"):
            projs = entry(file, f"{specimen}/projs", path)
            rows, columns = projs.shape[1:]
            step = round((detector.shape[0] - 2 * border_px) / rows)
            spans = [slice(border_px, border_px + (n - 1) * step + 1, step) for n in (rows, columns)]
            camera = detector.window(*spans)
            segs, lands = entry(file, f"{specimen}/segs", path), entry(file, f"{specimen}/lands", path)
            for n in range(len(projs)):
                yield Picture(
                    specimen,
                    f"{n:03d}",
                    torch.from_numpy(np.asarray(projs[n], dtype=np.float32)),
                    "log",
                    camera,
                    Display("posterior"),
                    torch.from_numpy(np.asarray(segs[n], dtype=np.uint8)),
                    {name: torch.from_numpy(np.asarray(lands[n, :, m], np.float64)) for m, name in enumerate(names)},
                    {},
                )
