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
from femoreg_torch.hdf5 import Hdf5File, open_hdf5
from femoreg_torch.neighbours.frames import XregCamera
from femoreg_torch.neighbours.xreg import camera_shape
from femoreg_torch.volume import Volume

BONES = ("hip_left", "hip_right", "vertebrae", "sacrum", "femur_left", "femur_right")  # labels 1 to 6
_OBJECTS = {"pelvis": "pelvis", "femur_left": "left-femur", "femur_right": "right-femur"}
_DEGREES = {False: 0, True: 180}
_MOST_LANDMARKS = 99  # their names have two digits


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
        if file.there("proj-params"):
            return True
        if file.there("land-names"):
            return False
    raise InputError(f"{path}: neither layout of the DeepFluoro data set: no `proj-params` and no `land-names`.")


def specimens(path: Path) -> list[str]:
    """Names of the specimens of a full-resolution file."""
    with open_hdf5(path) as file:
        return [name for name in file.names("/") if name != "proj-params"]


def read_specimen(path: Path, name: str) -> Specimen:
    """The CT, label map and landmarks of a specimen. Raises `InputError`."""
    with open_hdf5(path) as file:
        landmarks = {
            mark: file.matrix(f"{name}/vol-landmarks/{mark}", (3,)) for mark in file.names(f"{name}/vol-landmarks")
        }
        ct = _volume(file, f"{name}/vol", np.float32, path)
        labels = _volume(file, f"{name}/vol-seg/image", np.uint8, path)
    if labels.data.shape != ct.data.shape:
        raise InputError(f"{path}, {name}: its label map has another size than its CT. Download the file again.")
    return Specimen(name, ct, labels, landmarks)


def _volume(file: Hdf5File, name: str, dtype: Any, path: Path) -> Volume:
    stored = file.numbers(f"{name}/pixels", 3)
    values = stored.astype(dtype)
    if dtype == np.uint8 and (values != stored).any():
        raise InputError(f"{path}, {name}: labels are whole numbers from 0 to 255, and some are not.")
    affine = torch.eye(4, dtype=torch.float64)
    spacing, axes = file.matrix(f"{name}/spacing", (3,)), file.matrix(f"{name}/dir-mat", (3, 3))
    if not bool((spacing > 0).all()) or not torch.allclose(axes.T @ axes, torch.eye(3).to(axes), atol=1e-3):
        raise InputError(f"{path}, {name}: a spacing is not above 0, or its axes are not at right angles.")
    affine[:3, :3] = axes @ torch.diag(spacing)
    affine[:3, 3] = file.matrix(f"{name}/origin", (3,))
    return Volume(torch.from_numpy(values), affine)


def read_pictures(path: Path, specimen: str) -> Iterator[Picture]:
    """The pictures of a specimen of a full-resolution file, one after the other."""
    with open_hdf5(path) as file:
        carm = XregCamera(
            file.matrix("proj-params/intrinsic", (3, 3)),
            file.matrix("proj-params/extrinsic", (4, 4)),
            camera_shape(file, "proj-params/num-rows", "proj-params/num-cols", path),
            (
                file.scalar("proj-params/pixel-row-spacing"),
                file.scalar("proj-params/pixel-col-spacing"),
            ),
        )
        for name in file.names(f"{specimen}/projections"):
            yield _picture(file, carm, specimen, name, path)


def _picture(file: Hdf5File, carm: XregCamera, specimen: str, name: str, path: Path) -> Picture:
    group = f"{specimen}/projections/{name}"
    pixels = file.numbers(f"{group}/image/pixels", 2).astype(np.float32)
    if pixels.shape != carm.shape:
        raise InputError(f"{path}, {group}: the image is {pixels.shape}, but `proj-params` say {carm.shape}.")
    turn = f"{group}/rot-180-for-up"
    turned = file.there(turn) and bool(file.scalar(turn))
    display = Display("posterior", turned_deg=_DEGREES[turned])
    poses = {}
    for thing, told in _OBJECTS.items():
        key = f"{group}/gt-poses/cam-to-{told}-vol"
        trusted = f"{group}/gt-poses/{told}-good-fov"
        if file.there(key) and (not file.there(trusted) or file.scalar(trusted)):
            poses[thing] = carm.camera_from_lps(file.matrix(key, (4, 4)), display)
    known = [name for name in (f"{group}/gt-seg/pixels", f"{group}/gt-seg/image/pixels") if file.there(name)]
    labels = file.numbers(known[0], 2).astype(np.uint8) if known else None
    if labels is not None and labels.shape != carm.shape:
        raise InputError(f"{path}, {known[0]}: labels are {labels.shape}, but the image is {carm.shape}.")
    marks = file.names(f"{group}/gt-landmarks") if file.there(f"{group}/gt-landmarks") else []
    return Picture(
        specimen,
        name,
        torch.from_numpy(pixels),
        "raw",
        carm.camera,
        display,
        None if labels is None else torch.from_numpy(labels),
        {mark: file.matrix(f"{group}/gt-landmarks/{mark}", (2,)) for mark in marks},
        poses,
    )


def read_preprocessed(path: Path, detector: Camera, border_px: int = 50) -> Iterator[Picture]:
    """The pictures of a preprocessed file, whose every pixel is one of `detector`'s between borders that were cut off.

    Pixel u of a file that keeps every s-th one is pixel 50 + s u of the detector.
    """
    with open_hdf5(path) as file:
        count = file.whole("land-names/num-lands", 0, _MOST_LANDMARKS)
        names = [file.text(f"land-names/land-{n:02d}") for n in range(count)]
        for specimen in file.names("/"):
            if specimen == "land-names":
                continue
            projs, segs, lands = (f"{specimen}/{part}" for part in ("projs", "segs", "lands"))
            images, rows, columns = file.shape(projs, 3)
            if file.shape(segs, 3) != (images, rows, columns):
                raise InputError(f"{path}, {segs}: the shape of `{projs}`, {(images, rows, columns)}, was expected.")
            if file.shape(lands, 3) != (images, 2, count):
                raise InputError(f"{path}, {lands}: {(images, 2, count)} numbers were expected.")
            camera = _coarser(detector, rows, columns, border_px, f"{path}, {projs}")
            for n in range(images):
                marks = file.numbers(lands, 3, at=n, finite=False).astype(np.float64)  # infinite where unseen
                yield Picture(
                    specimen,
                    f"{n:03d}",
                    torch.from_numpy(file.numbers(projs, 3, at=n).astype(np.float32)),
                    "log",
                    camera,
                    Display("posterior"),
                    torch.from_numpy(file.numbers(segs, 3, at=n).astype(np.uint8)),
                    {name: torch.from_numpy(marks[:, m]) for m, name in enumerate(names)},
                    {},
                )


def _coarser(detector: Camera, rows: int, columns: int, border_px: int, where: str) -> Camera:
    """The camera of a picture of every s-th pixel of a detector within its border."""
    within = [n - 2 * border_px for n in detector.shape]
    step = round(within[0] / rows)
    spans = [slice(border_px, border_px + (n - 1) * step + 1, step) for n in (rows, columns)] if step else []
    if not spans or any(span.stop > border_px + inside for span, inside in zip(spans, within, strict=True)):
        raise InputError(f"{where}: {rows} × {columns} pixels are no coarser grid on {within[0]} × {within[1]} ones.")
    return detector.window(*spans)
