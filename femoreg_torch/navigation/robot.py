"""The robot's calibration: where its base sees the device at the moment of the device images."""

from dataclasses import dataclass
from pathlib import Path

import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import check_rigid, invert_rigid, rigid

_DIRECT = {"base_from_device"}
_BY_FLANGE = {"base_from_flange", "flange_from_device"}
_FORMAT = (
    "a line `base_from_device` and four rows of four numbers below it, or the same for both `base_from_flange` and "
    "`flange_from_device`, in mm"
)
_LEAST_REACH_MM = 10.0  # no device stands this close to the base of its robot: the numbers are metres


@dataclass(frozen=True, eq=False)
class Robot:
    """Poses (4, 4), float64, mm, at the moment of the device images; the flange's only where the file tells it."""

    base_from_device: Tensor
    base_from_flange: Tensor | None = None


def read_robot(path: Path) -> Robot:
    """The calibration in a file: 4×4 text with named matrices, or an ITK `.tfm` named `base_from_device.tfm`.

    Text: `#` starts a comment; a line with a name says which frames the four rows below it tie. A file of one matrix
    may leave the line out if the file itself bears the name. A `.tfm` is in ITK's direction, as 3D Slicer saves it: it
    takes points of the base to the device. Raises `InputError` that names file and matrix for whatever is not rigid,
    not finite, of another shape, missing or unknown, or in metres.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file. The robot's calibration holds {_FORMAT}.")
    found = {path.stem: _read_tfm(path)} if path.suffix.lower() == ".tfm" else _read_text(path)
    if set(found) not in (_DIRECT, _BY_FLANGE):
        names = ", ".join(f"`{name}`" for name in found) or "no matrix"
        raise InputError(f"{path}: holds {names}. Expected: {_FORMAT}.")
    poses = {name: _exactly_rigid(check_rigid(matrix, f"{path}, {name}")) for name, matrix in found.items()}
    base_from_flange = poses.get("base_from_flange")
    if base_from_flange is None:
        base_from_device = poses["base_from_device"]
    else:
        base_from_device = base_from_flange @ poses["flange_from_device"]
    if (distance := base_from_device[:3, 3].norm().item()) < _LEAST_REACH_MM:
        raise InputError(
            f"{path}: the device would stand {distance:.3g} mm from the robot's base. Are the translations in metres? "
            "Write them in mm."
        )
    return Robot(base_from_device, base_from_flange)


def _exactly_rigid(pose: Tensor) -> Tensor:
    """The nearest rotation in place of one with few digits: an arm of a metre turns 0.0001 into 0.1 mm."""
    u, _, vh = torch.linalg.svd(pose[:3, :3])
    return rigid(u @ vh, pose[:3, 3])


def _read_text(path: Path) -> dict[str, Tensor]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text. Expected: {_FORMAT}.") from error
    name = path.stem
    rows: dict[str, list[list[float]]] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if len(words) == 1 and words[0] in _DIRECT | _BY_FLANGE:
            name = words[0]
            if name in rows:
                raise InputError(f"{path}, line {number}: `{name}` stands there twice. Keep one.")
        elif words:
            rows.setdefault(name, []).append(_row(words, f"{path}, line {number}"))
    for key, matrix in rows.items():
        if len(matrix) != 4:
            raise InputError(f"{path}, {key}: {len(matrix)} rows found, a 4×4 matrix has four.")
    return {key: torch.tensor(matrix, dtype=torch.float64) for key, matrix in rows.items()}


def _row(words: list[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 4:
        raise InputError(f"{where}: four numbers or the name of a matrix were expected, found {' '.join(words)!r}.")
    return values


def _read_tfm(path: Path) -> Tensor:
    """`b_from_a` (4, 4) of a file that takes points of b to a."""
    try:
        transform = sitk.ReadTransform(str(path))
    except RuntimeError as error:
        reason = " ".join(str(error).split()).rpartition("): ")[2]
        raise InputError(f"{path}: cannot be read as an ITK transform ({reason}).") from error
    if transform.GetDimension() != 3 or not transform.IsLinear():
        raise InputError(f"{path}: a rigid transform in 3D was expected, found {transform.GetName()}.")
    origin, *axes = (
        torch.tensor(transform.TransformPoint(point), dtype=torch.float64)
        for point in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    a_from_b = rigid(torch.stack([axis - origin for axis in axes], 1), origin)
    return invert_rigid(check_rigid(a_from_b, str(path)))
