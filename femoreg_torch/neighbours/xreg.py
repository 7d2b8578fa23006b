"""xReg's HDF5 files of projections ("proj-data"), and its poses as ITK transforms.

Layout (xregH5ProjDataIO.cpp, xregH5CamModelIO.cpp, xregHDF5Internal.h):

    num-projs                            scalar
    proj-000/cam/intrinsic, extrinsic    3 × 3, 4 × 4
    proj-000/cam/num-rows, num-cols      scalars; row-spacing, col-spacing in mm
    proj-000/cam/cam-coord-frame-type    text
    proj-000/img/pixels                  rows × columns
    proj-000/landmarks/<name>            2 × 1: column, row
    proj-000/rot-to-pat-up               0, 90, 180, 270: degrees that turn the picture head up
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import invert_rigid, read_itk_transform
from femoreg_torch.neighbours.frames import XregCamera


@dataclass(frozen=True, eq=False)
class Projection:
    """One picture and its camera."""

    image: Tensor | None  # (H, W) float32, as stored
    camera: XregCamera
    landmarks: dict[str, Tensor]  # (2,) column, row
    turn_deg: int | None  # what turns the picture head up; None: not said


def read_projections(path: Path) -> list[Projection]:
    """All projections of a file. Raises `InputError` for what is missing or of another shape."""
    with open_hdf5(path) as file:
        if "num-projs" not in file:
            raise InputError(f"{path}: no projection data of xReg, it has no `num-projs`.")
        return list(_projections(file, path))


def _projections(file: Any, path: Path) -> Iterator[Projection]:
    for n in range(int(scalar(file, "num-projs", path))):
        group = f"proj-{n:03d}"
        cam = f"{group}/cam"
        shape = (int(scalar(file, f"{cam}/num-rows", path)), int(scalar(file, f"{cam}/num-cols", path)))
        camera = XregCamera(
            matrix(file, f"{cam}/intrinsic", (3, 3), path),
            matrix(file, f"{cam}/extrinsic", (4, 4), path),
            shape,
            (scalar(file, f"{cam}/row-spacing", path), scalar(file, f"{cam}/col-spacing", path)),
            text(file, f"{cam}/cam-coord-frame-type", path),
        )
        image = None
        if f"{group}/img/pixels" in file:
            pixels = np.asarray(file[f"{group}/img/pixels"], dtype=np.float32)
            if pixels.shape != shape:
                raise InputError(f"{path}, {group}: the image is {pixels.shape}, but its camera has {shape} pixels.")
            image = torch.from_numpy(pixels)
        names = list(file[f"{group}/landmarks"]) if f"{group}/landmarks" in file else []
        landmarks = {name: matrix(file, f"{group}/landmarks/{name}", (2,), path) for name in names}
        turn = int(scalar(file, f"{group}/rot-to-pat-up", path)) if f"{group}/rot-to-pat-up" in file else None
        yield Projection(image, camera, landmarks, turn)


def open_hdf5(path: Path) -> Any:
    """An HDF5 file for reading. Raises `InputError` if it is missing or something else."""
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file.")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise InputError(f"{path}: cannot be read as HDF5; the file is damaged or something else.") from error


def entry(file: Any, name: str, path: Path) -> Any:
    """The data set of a name. Raises `InputError` where there is none."""
    if name not in file or not isinstance(file[name], h5py.Dataset):
        raise InputError(f"{path}: `{name}` is missing.")
    return file[name]


def scalar(file: Any, name: str, path: Path) -> float:
    """A finite number."""
    values = np.asarray(entry(file, name, path)).ravel()
    if values.size != 1 or not np.isfinite(values).all():
        raise InputError(f"{path}, {name}: one number was expected.")
    return float(values[0])


def text(file: Any, name: str, path: Path) -> str:
    """A text."""
    value = entry(file, name, path)[()]
    value = value.ravel()[0] if isinstance(value, np.ndarray) else value
    return value.decode() if isinstance(value, bytes) else str(value)


def matrix(file: Any, name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """Finite numbers of a shape, float64; vectors may stand as a column."""
    values = np.asarray(entry(file, name, path), dtype=np.float64)
    if len(shape) == 1 and values.size == shape[0]:
        values = values.ravel()
    if values.shape != shape or not np.isfinite(values).all():
        expected = " × ".join(map(str, shape))
        raise InputError(f"{path}, {name}: {expected} finite numbers were expected, found {values.shape}.")
    return torch.from_numpy(values)


def read_transform(path: Path) -> Tensor:
    """The rigid matrix (4, 4) of an ITK transform file, `.h5` or `.tfm`, as it takes points. Raises `InputError`."""
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file.")
    return invert_rigid(read_itk_transform(path))


def write_transform(path: Path, matrix: Tensor) -> None:
    """Write a rigid matrix (4, 4) as an ITK affine transform, `.h5` or `.tfm`, as it takes points."""
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(matrix[:3, :3].double().flatten().tolist())
    transform.SetTranslation(matrix[:3, 3].double().tolist())
    sitk.WriteTransform(transform, str(path))
