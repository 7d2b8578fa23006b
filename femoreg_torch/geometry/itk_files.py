"""Rigid transforms in files of ITK and 3D Slicer: `.tfm`, `.txt`, `.mat`, `.h5`."""

import io
import math
import re
import tempfile
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry.rigid import check_rigid, invert_rigid, rigid
from femoreg_torch.paths import check_readable
from femoreg_torch.text import read_bytes

_MOST_BYTES = 2**18  # of a file with one transform
_MOST_NUMBERS = 64
_Numbers = tuple[str, list[float], list[float]]  # kind, parameters, fixed parameters

# Linear transforms in 3-D, and how many parameters they have.
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
    text = _transform_text(path)
    try:
        with tempfile.TemporaryDirectory() as folder, quiet():
            (Path(folder) / "transform.tfm").write_text(text, encoding="utf-8")
            transform = sitk.ReadTransform(str(Path(folder) / "transform.tfm"))
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


def _transform_text(path: Path) -> str:
    """A linear transform in 3-D as ITK writes it as text, so that ITK itself reads no foreign file.

    ITK crashes on files with too few numbers, and its HDF5 library does not come to an end on some damaged ones. Raises
    `InputError` for a file that holds something else.
    """
    of_kind = _READERS.get(Path(path).suffix.lower())
    if of_kind is None:
        raise InputError(f"{path}: a name that ends in {', '.join(_READERS)} was expected.")
    check_readable(Path(path))
    try:
        kind, parameters, fixed = of_kind(path)
        if not all(map(math.isfinite, (*parameters, *fixed))):
            raise ValueError("its numbers are not all finite")
    except InputError:
        raise
    except Exception as error:  # the reader of MATLAB files raises whatever its parsing runs into
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cannot be read as an ITK transform ({reason}).") from error
    name = kind.partition("_")[0]
    if name not in _PARAMETERS:
        raise InputError(f"{path}: a rigid transform in 3D was expected, found {shortened(kind)}.")
    if (
        not re.fullmatch(r"[A-Za-z0-9]+_(double|float)_3_3", kind)
        or len(parameters) != _PARAMETERS[name]
        or len(fixed) not in _FIXED
    ):
        raise InputError(
            f"{path}: cannot be read as an ITK transform ({shortened(kind)} with {len(parameters)} parameters and "
            f"{len(fixed)} fixed ones)."
        )
    numbers = [" ".join(map(repr, some)) for some in (parameters, fixed)]
    return (
        f"#Insight Transform File V1.0\n#Transform 0\nTransform: {kind}\nParameters: {numbers[0]}\n"
        f"FixedParameters: {numbers[1]}\n"
    )


def _of_text(path: Path) -> _Numbers:
    """The kind of a transform, its parameters and its fixed ones, all finite. Raises `ValueError`."""
    found: dict[str, str] = {}
    for line in read_bytes(path, _MOST_BYTES).decode("utf-8").splitlines():
        key, colon, value = line.partition(":")
        if line.startswith("#") or not line.strip():
            continue
        if not colon or key in found or key not in ("Transform", "Parameters", "FixedParameters"):
            raise ValueError("one transform was expected, with Parameters and FixedParameters")
        found[key] = value.strip()
    parameters, fixed = (
        [float(word) for word in found.get(key, "").split()] for key in ("Parameters", "FixedParameters")
    )
    return found["Transform"], parameters, fixed


def _of_matlab(path: Path) -> _Numbers:
    """As `_of_text`, of a MATLAB file. Raises `ValueError`, and what its reader runs into."""
    from scipy.io import loadmat  # here, as it is slow to load and most cases have no such file

    content = io.BytesIO(read_bytes(path, _MOST_BYTES))
    with quiet():  # it warns of number formats that it does not know, and reads on
        found = {name: value for name, value in loadmat(content).items() if not name.startswith("__")}
    (kind,) = (name for name in found if name != "fixed")
    parameters, fixed = (np.asarray(found.get(key, ()), dtype=float).ravel().tolist() for key in (kind, "fixed"))
    return kind, parameters, fixed


def _of_hdf5(path: Path) -> _Numbers:
    """As `_of_text`, of an HDF5 file. Raises `InputError`."""
    from femoreg_torch.hdf5 import open_hdf5  # h5py is of the extra `sim`

    with open_hdf5(path) as file:
        if file.names("TransformGroup") != ["0"]:
            raise ValueError("one transform was expected")
        numbers = []
        for name in ("TransformParameters", "TransformFixedParameters"):
            older = name.replace("Transform", "Tranform")  # as older ITKs spell it
            known = older if file.there(f"TransformGroup/0/{older}") else name
            numbers.append(file.listed(f"TransformGroup/0/{known}", _MOST_NUMBERS))
        return file.text("TransformGroup/0/TransformType"), numbers[0], numbers[1]


_READERS = {".tfm": _of_text, ".txt": _of_text, ".mat": _of_matlab, ".h5": _of_hdf5, ".hdf5": _of_hdf5}
