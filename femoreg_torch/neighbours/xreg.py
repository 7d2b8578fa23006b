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

import errno
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.arrays import MOST_PIXELS, check_pixels
from femoreg_torch.errors import InputError
from femoreg_torch.files import check_suffix, temporary_file
from femoreg_torch.geometry import invert_rigid, read_itk_transform
from femoreg_torch.geometry.rigid import check_rigid
from femoreg_torch.hdf5 import Hdf5File, open_hdf5
from femoreg_torch.neighbours.frames import XregCamera

_SAME_MM = 1e-6  # by which a pose that was written may differ
_MOST_PROJECTIONS = 1000  # names have three digits


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
        if not file.there("num-projs"):
            raise InputError(f"{path}: no projection data of xReg, it has no `num-projs`.")
        return list(_projections(file, path))


def _projections(file: Hdf5File, path: Path) -> Iterator[Projection]:
    for n in range(file.whole("num-projs", 0, _MOST_PROJECTIONS)):
        group = f"proj-{n:03d}"
        cam = f"{group}/cam"
        shape = camera_shape(file, f"{cam}/num-rows", f"{cam}/num-cols", path)
        camera = XregCamera(
            file.matrix(f"{cam}/intrinsic", (3, 3)),
            file.matrix(f"{cam}/extrinsic", (4, 4)),
            shape,
            (file.scalar(f"{cam}/row-spacing"), file.scalar(f"{cam}/col-spacing")),
            file.text(f"{cam}/cam-coord-frame-type"),
        )
        image = None
        if file.there(f"{group}/img/pixels"):
            pixels = file.numbers(f"{group}/img/pixels", 2).astype("float32")
            if pixels.shape != shape:
                raise InputError(f"{path}, {group}: the image is {pixels.shape}, but its camera has {shape} pixels.")
            image = torch.from_numpy(pixels)
        marks = f"{group}/landmarks"
        names = file.names(marks) if file.there(marks) else []
        landmarks = {name: file.matrix(f"{marks}/{name}", (2,)) for name in names}
        turn = f"{group}/rot-to-pat-up"
        yield Projection(image, camera, landmarks, int(file.scalar(turn)) if file.there(turn) else None)


def camera_shape(file: Hdf5File, rows: str, columns: str, path: Path) -> tuple[int, int]:
    """Rows and columns of a detector, from these entries. Raises `InputError` for more than any has."""
    found = (file.whole(rows, 1, MOST_PIXELS), file.whole(columns, 1, MOST_PIXELS))
    check_pixels(path, *found)
    return found


def read_transform(path: Path) -> Tensor:
    """The rigid matrix (4, 4) of an ITK transform file, `.h5` or `.tfm`, as it takes points. Raises `InputError`."""
    return invert_rigid(read_itk_transform(path))


def write_transform(path: Path, matrix: Tensor) -> None:
    """Write a rigid matrix (4, 4) as an ITK affine transform, `.h5`, `.tfm` or `.txt`, as it takes points.

    Raises `InputError` for another name and for what is not rigid, and `OSError` where it cannot be written.
    """
    check_suffix(Path(path), (".h5", ".tfm", ".txt"))
    matrix = check_rigid(matrix.double().cpu(), f"the transform for {path}")
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(matrix[:3, :3].double().flatten().tolist())
    transform.SetTranslation(matrix[:3, 3].double().tolist())
    with temporary_file(Path(path)) as part:
        try:
            sitk.WriteTransform(transform, str(part))
            written = read_transform(part)
        except (RuntimeError, InputError) as error:  # ITK does not say why
            raise OSError(errno.EIO, "cannot be written. Is the disk full?", str(path)) from error
        if not torch.allclose(
            written, matrix.double().cpu(), rtol=0, atol=_SAME_MM
        ):  # it does not say that a text was cut off
            raise OSError(errno.ENOSPC, "cannot be written whole. Is the disk full?", str(path))
