"""Rigid transforms in files of ITK and 3D Slicer: `.tfm`, `.txt`, `.mat`, `.h5`."""

import io
import math
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry.rigid import check_rigid, invert_rigid, rigid
from femoreg_torch.text import read_bytes

_MOST_BYTES = 2**18  # of a file with one transform
_MOST_NUMBERS = 64


# Linear transforms in 3-D, and how many parameters they have. ITK crashes on files whose numbers are fewer.
_PARAMETERS = {
    "AffineTransform": 12, "MatrixOffsetTransformBase": 12, "Euler3DTransform": 6, "VersorRigid3DTransform": 6,
    "Rigid3DTransform": 12, "VersorTransform": 3, "QuaternionRigidTransform": 7, "Similarity3DTransform": 7,
    "ScaleVersor3DTransform": 9, "ScaleSkewVersor3DTransform": 15, "ScaleTransform": 3, "TranslationTransform": 3,
    "IdentityTransform": 0,
}  # fmt: skip
_FIXED = (0, 3, 4)  # a centre, or none; Euler angles have a flag for their order besides


def read_itk_transform(path: Path) -> Tensor:
    """`b_from_a` (4, 4), float64, LPS mm, of a file in ITK's direction, which takes points of b to a.

    3D Slicer saves a transform so: under `b_from_a` a model of frame a appears in frame b. Raises `InputError` for what
    is no rigid transform in 3-D.
    """
    check_transform_file(path)
    try:
        with quiet():
            transform = sitk.ReadTransform(str(path))
    except (RuntimeError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split()).rpartition("): ")[2][:200]
        raise InputError(f"{path}: cannot be read as an ITK transform ({reason}).") from error
    if transform.GetDimension() != 3 or not transform.IsLinear():
        raise InputError(f"{path}: a rigid transform in 3D was expected, found {transform.GetName()}.")
    origin, *axes = (
        torch.tensor(transform.TransformPoint(point), dtype=torch.float64)
        for point in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    a_from_b = rigid(torch.stack([axis - origin for axis in axes], 1), origin)
    return invert_rigid(check_rigid(a_from_b, str(path)))


def check_transform_file(path: Path) -> None:
    """Raises `InputError` for a file that does not hold the numbers of one linear transform in 3-D."""
    of_kind = _READERS.get(Path(path).suffix.lower())
    if of_kind is None:
        raise InputError(f"{path}: a name that ends in {', '.join(_READERS)} was expected.")
    content = read_bytes(path, _MOST_BYTES)
    try:  # what the readers of MATLAB and HDF5 files raise for whatever their parsing runs into
        kind, numbers, fixed = of_kind(content)
    except (ValueError, TypeError, KeyError, AttributeError, OSError, RuntimeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cannot be read as an ITK transform ({reason}).") from error
    name = kind.partition("_")[0]
    if name not in _PARAMETERS:
        raise InputError(f"{path}: a rigid transform in 3D was expected, found {shortened(kind)}.")
    if not kind.endswith("_3_3") or numbers != _PARAMETERS[name] or fixed not in _FIXED:
        raise InputError(
            f"{path}: cannot be read as an ITK transform ({shortened(kind)} with {numbers} parameters and {fixed} "
            "fixed ones)."
        )


def _of_text(content: bytes) -> tuple[str, int, int]:
    """The kind of a transform, and how many finite parameters and fixed ones it has. Raises `ValueError`."""
    found: dict[str, str] = {}
    for line in content.decode("utf-8").splitlines():
        key, colon, value = line.partition(":")
        if line.startswith("#") or not line.strip():
            continue
        if not colon or key in found or key not in ("Transform", "Parameters", "FixedParameters"):
            raise ValueError("one transform was expected, with Parameters and FixedParameters")
        found[key] = value.strip()
    counts = []
    for key in ("Parameters", "FixedParameters"):
        values = [float(word) for word in found.get(key, "").split()]
        if not all(map(math.isfinite, values)):
            raise ValueError(f"{key} are not all finite")
        counts.append(len(values))
    return found["Transform"], counts[0], counts[1]


def _of_matlab(content: bytes) -> tuple[str, int, int]:
    """As `_of_text`, of a MATLAB file. Raises `ValueError`."""
    from scipy.io import loadmat  # here, as it is slow to load and most cases have no such file

    found = {name: value for name, value in loadmat(io.BytesIO(content)).items() if not name.startswith("__")}
    (kind,) = (name for name in found if name != "fixed")
    if not all(np.isfinite(np.asarray(value, dtype=float)).all() for value in found.values()):
        raise ValueError("its numbers are not all finite")
    return kind, int(np.size(found[kind])), int(np.size(found.get("fixed", ())))


def _of_hdf5(content: bytes) -> tuple[str, int, int]:
    """As `_of_text`, of an HDF5 file. Raises `ValueError`, and what h5py raises."""
    import h5py  # of the extra `sim`

    with h5py.File(io.BytesIO(content), "r") as file:
        transforms = file["TransformGroup"]
        if list(transforms) != ["0"]:
            raise ValueError("one transform was expected")
        transform = transforms["0"]
        counts = []
        for name in ("TransformParameters", "TransformFixedParameters"):
            values = transform.get(name, transform.get(name.replace("Transform", "Tranform")))  # as older ITKs spell it
            if values is None or values.size is None or values.size > _MOST_NUMBERS:
                raise ValueError(f"{name} are not the numbers of a linear transform")
            if not np.isfinite(values[()]).all():
                raise ValueError(f"{name} are not all finite")
            counts.append(int(values.size))
        return str(transform["TransformType"].asstr()[0]), counts[0], counts[1]


_READERS = {".tfm": _of_text, ".txt": _of_text, ".mat": _of_matlab, ".h5": _of_hdf5, ".hdf5": _of_hdf5}
