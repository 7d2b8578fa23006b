"""The robot's calibration: where its base sees the tool at the moment of the tool's images."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.errors import InputError, in_mm, shortened
from femoreg_torch.geometry import check_rigid, read_itk_transform
from femoreg_torch.paths import check_readable
from femoreg_torch.text import MOST_YAML_BYTES, read_bytes

_LEAST_REACH_MM = 10.0  # no tool or flange stands this close to the base of its robot: the numbers are metres
_TOOL_IN_METRES = 0.02, 2.0  # so far a tool's origin lies from its flange in m, and hardly any in mm


@dataclass(frozen=True, eq=False)
class Robot:
    """Poses (4, 4), float64, mm, at the moment of the tool's images; the flange's only where the file tells it."""

    base_from_tool: Tensor
    base_from_flange: Tensor | None = None


@dataclass(frozen=True)
class _Names:
    """What the matrices of a calibration are called, after the tool."""

    tool: str

    @property
    def direct(self) -> set[str]:
        return {f"base_from_{self.tool}"}

    @property
    def by_flange(self) -> set[str]:
        return {"base_from_flange", f"flange_from_{self.tool}"}

    @property
    def format(self) -> str:
        """What a file holds, in words."""
        return (
            f"a line `base_from_{self.tool}` and four rows of four numbers below it, or the same for both "
            f"`base_from_flange` and `flange_from_{self.tool}`, in mm"
        )


def read_robot(path: Path, tool: str) -> Robot:
    """The calibration in a file: 4×4 text with named matrices, or an ITK `.tfm` named `base_from_<tool>.tfm`.

    Text: `#` starts a comment; a line with a name says which frames the four rows below it tie. A file of one matrix
    may leave the line out if the file itself bears the name. A `.tfm` is in ITK's direction, as 3D Slicer saves it: it
    takes points of the base to the tool. Raises `InputError` that names file and matrix for whatever is not rigid,
    not finite, of another shape, missing or unknown, or in metres.
    """
    path, names = Path(path), _Names(tool)
    check_readable(path, f"The robot's calibration holds {names.format}.")
    found = {path.stem: read_itk_transform(path)} if path.suffix.lower() == ".tfm" else _read_text(path, names)
    if set(found) not in (names.direct, names.by_flange):
        there = ", ".join(f"`{name}`" for name in found) or "no matrix"
        raise InputError(f"{path}: holds {there}. Expected: {names.format}.")
    poses = {name: check_rigid(matrix, f"{path}, {name}") for name, matrix in found.items()}
    base_from_flange = poses.get("base_from_flange")
    if base_from_flange is None:
        base_from_tool = poses[f"base_from_{tool}"]
    else:
        flange_from_tool = poses[f"flange_from_{tool}"]
        if _TOOL_IN_METRES[0] < (distance := flange_from_tool[:3, 3].norm().item()) < _TOOL_IN_METRES[1]:
            raise _in_metres(path, tool, distance, "its flange", f" If it does, give `base_from_{tool}` alone.")
        if (distance := base_from_flange[:3, 3].norm().item()) < _LEAST_REACH_MM:
            raise _in_metres(path, "flange", distance, "the robot's base")
        base_from_tool = base_from_flange @ flange_from_tool
    if (distance := base_from_tool[:3, 3].norm().item()) < _LEAST_REACH_MM:
        raise _in_metres(path, tool, distance, "the robot's base")
    return Robot(base_from_tool, base_from_flange)


def _in_metres(path: Path, what: str, distance: float, place: str, way_out: str = "") -> InputError:
    return InputError(
        f"{path}: the {what} would stand {in_mm(distance)} from {place}. Are the translations in metres? Write them in "
        f"mm.{way_out}"
    )


def _read_text(path: Path, names: _Names) -> dict[str, Tensor]:
    try:
        lines = read_bytes(path, MOST_YAML_BYTES).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text. Expected: {names.format}.") from error
    name = path.stem
    rows: dict[str, list[list[float]]] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if len(words) == 1 and words[0] in names.direct | names.by_flange:
            name = words[0]
            if name in rows:
                raise InputError(f"{path}, line {number}: `{name}` stands there twice. Keep one.")
        elif words:
            rows.setdefault(name, []).append(_row(words, f"{path}, line {number}", names))
    for key, matrix in rows.items():
        if len(matrix) != 4:
            raise InputError(f"{path}, {key}: {len(matrix)} rows found, a 4×4 matrix has four.")
    return {key: torch.tensor(matrix, dtype=torch.float64) for key, matrix in rows.items()}


def _row(words: list[str], where: str, names: _Names) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 4:
        raise InputError(
            f"{where}: four numbers or the name of a matrix ({', '.join(sorted(names.direct | names.by_flange))}) were "
            f"expected, found {shortened(' '.join(words))}."
        )
    return values
