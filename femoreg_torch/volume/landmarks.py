"""Files of landmarks, in 3-D. Inside, landmarks are LPS mm, in the order of their anatomy."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.delimited import Row, check_decimal_marks, decimal, read_csv, read_lines, rows_of, separator_of
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import read_json, write_json
from femoreg_torch.geometry.rigid import FARTHEST_MM
from femoreg_torch.volume.grid import Volume

_LPS_FROM = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}
_SPACES = {"0": "RAS", "1": "LPS", "RAS": "RAS", "LPS": "LPS"}  # numbers as in 3D Slicer before 4.11
_LONGEST_NAME = 60  # characters of a point's name that a message repeats as they are
_AXES = {"LPS": ("l", "p", "s"), "RAS": ("r", "a", "s")}  # columns of a table
_TABLES = (".csv", ".tsv")
_AROUND_REMARKS = '" ;,\t'  # what spreadsheets put around the lines with #
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


@dataclass(frozen=True)
class _Given:
    """A point as a file gives it, nothing checked."""

    space: Any
    label: Any
    position: Any
    line: str = ""  # `line 3, ` where it is known


def _signs(space: Any, where: str) -> tuple[float, float, float]:
    if space is None:
        raise InputError(
            f'{where}: the file does not say it. Write `"coordinateSystem": "LPS"`, or "RAS", beside `controlPoints`, '
            "or save the points anew with 3D Slicer."
        )
    if not isinstance(space, str) or space not in _LPS_FROM:
        raise InputError(f"{where}: the space must be LPS or RAS, found {shortened(space)}.")
    return _LPS_FROM[space]


def _check_unit(unit: Any, where: str) -> None:
    if unit not in ("mm", ["mm"] * 3):  # of each axis
        raise InputError(f"{where}: the unit must be mm, found {shortened(unit)}. Convert the points.")


def _plain_points(content: dict[str, Any], path: Path, example: str) -> list[_Given]:
    """The points of our own format; `example` is a name that one may have."""
    for key in ("space", "unit", "landmarks"):
        if key not in content:
            raise InputError(
                f"{path}: `{key}` is missing. Either 3D Slicer markups were expected or "
                f'{{"space": "LPS", "unit": "mm", "landmarks": {{"{example}": [x, y, z], …}}}}.'
            )
    _check_unit(content["unit"], f"{path}, unit")
    if not isinstance(content["landmarks"], dict):
        raise InputError(f"{path}, landmarks: an object of names and points was expected.")
    return [_Given(content["space"], name, value) for name, value in content["landmarks"].items()]


def _slicer_points(content: dict[str, Any], path: Path) -> list[_Given]:
    """Every point that is placed, of all lists in the file."""
    markups = content["markups"]
    if not isinstance(markups, list) or not markups or not all(isinstance(markup, dict) for markup in markups):
        raise InputError(f"{path}, markups: one list of points was expected.")
    found = []
    for markup in markups:
        _check_unit(markup.get("coordinateUnits", "mm"), f"{path}, coordinateUnits")
        points = markup.get("controlPoints")
        if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
            raise InputError(f"{path}, controlPoints: a list of points was expected.")
        placed = (point for point in points if point.get("positionStatus", "defined") == "defined")
        space = markup.get("coordinateSystem")
        found += [_Given(_SPACES.get(str(space), space), point.get("label"), point.get("position")) for point in placed]
    return found


def _fcsv_points(path: Path) -> list[_Given]:
    """Without a line that tells the space it is RAS: that of 3D Slicer before 4.11, and of xReg."""
    lines = read_lines(path)
    told = [line.strip(_AROUND_REMARKS) for line in lines if _is_remark(line)]
    header = {key.strip("# "): value.strip() for key, _, value in (line.partition("=") for line in told)}
    space = header.get("CoordinateSystem", "RAS")
    columns = [name.strip() for name in re.split("[,;\t]", header.get("columns", _FCSV_COLUMNS))]
    needed = ("label", "x", "y", "z")
    if missing := set(needed) - set(columns):
        raise InputError(f"{path}: its columns lack {', '.join(sorted(missing))}. Save it anew with 3D Slicer.")
    values = ["" if _is_remark(line) else line for line in lines]
    separator = separator_of(values, max(columns.index(name) for name in needed) + 1)
    rows = list(rows_of(values, columns, needed, separator, str(path)))
    return _of_rows(rows, {_SPACES.get(space.upper(), space): ("x", "y", "z")}, path)


def _is_remark(line: str) -> bool:
    return line.lstrip('" ').startswith("#")


def _csv_points(path: Path) -> list[_Given]:
    """The points of a table as 3D Slicer exports it, whose columns tell the space: l, p, s or r, a, s."""
    read = read_csv(path, ("label",))
    rows = [replace(row, values={name.lower(): value for name, value in row.values.items()}) for row in read]
    axes = {space: letters for space, letters in _AXES.items() if set(letters) <= set(rows[0].values)}
    if len(axes) != 1:
        raise InputError(
            f"{path}: columns `label` and `l`, `p`, `s` (or `r`, `a`, `s`) in mm were expected, found "
            f"{shortened(', '.join(rows[0].values), 80)}. Other names do not say which way x, y and z run."
        )
    placed = [row for row in rows if row.values.get("defined", "1") not in ("0", "false")]
    return _of_rows(placed, axes, path)


def _of_rows(rows: list[Row], axes: Mapping[str, tuple[str, ...]], path: Path) -> list[_Given]:
    ((space, columns),) = axes.items()
    check_decimal_marks(rows, columns, str(path))
    return [
        _Given(space, row.values["label"], [_number(row.values[name]) for name in columns], f"line {row.line}, ")
        for row in rows
    ]


def _number(text: str) -> float | str:
    try:
        return decimal(text)
    except ValueError:
        return text


def _point(value: Any, where: str) -> Tensor:
    try:
        if not isinstance(value, list):
            raise TypeError
        point = torch.tensor([float(v) for v in value], dtype=torch.float64)
    except (TypeError, ValueError, OverflowError):
        point = torch.empty(0)
    if point.shape != (3,) or not torch.isfinite(point).all() or point.abs().max() > FARTHEST_MM:
        commas = " Are these decimal commas? Write points." if isinstance(value, list) and len(value) == 6 else ""
        raise InputError(
            f"{where}: three finite numbers [x, y, z] in mm were expected, found {shortened(value)}.{commas}"
        )
    return point


def read_landmarks(path: Path, known: Sequence[str] | None = HIP.landmark_names) -> dict[str, Tensor]:
    """Landmarks (3,) float64, LPS mm, in the order of the `known` names; a file may hold fewer.

    Without known names any will do, in the order of the file. Known names may be written in capitals or small letters,
    with `_`, a space or nothing in place of `-`. Formats: `{"space": "LPS", "unit": "mm", "landmarks": {name: [x, y,
    z]}}`, 3D Slicer markups (`.mrk.json`), `.fcsv` (also of xReg) and tables of Slicer (`.csv`, `.tsv`), each in LPS or
    RAS as its header says. Values of tables may stand between semicolons, with decimal commas. Raises `InputError` for
    an unknown or repeated name, another unit or space, or a point that is not three finite numbers.
    """
    path = Path(path)
    told = "" if known is None else f" Known names: {', '.join(known)}."
    spelt = {} if known is None else {_plain_name(name): name for name in known}
    found: dict[str, Tensor] = {}
    for label, point in _points(path, next(iter(known or HIP.landmark_names))):
        name = label if known is None else spelt.get(_plain_name(label), "")
        if not name:
            raise InputError(f"{path}: unknown landmark {shortened(label)}.{told}")
        if name in found:
            raise InputError(f"{path}: landmark {_told(name)} stands there twice. Keep one.")
        found[name] = point
    if not found:
        raise InputError(f"{path}: holds no landmark.{told}")
    return {name: found[name] for name in (known or found) if name in found}


def _told(name: str) -> str:
    """A point's name for a message, shortened where nobody would have written it."""
    return name if len(name) <= _LONGEST_NAME else shortened(name)


def _plain_name(text: str) -> str:
    return "".join(letter for letter in text.lower() if letter not in " _-")


def _points(path: Path, example: str) -> list[tuple[str, Tensor]]:
    """Name and position (3,), LPS mm, of every point in a file, in its order. Raises `InputError`."""
    if path.suffix.lower() == ".fcsv":
        points = _fcsv_points(path)
    elif path.suffix.lower() in _TABLES:
        points = _csv_points(path)
    else:
        content = read_json(path, with_nan=True)  # of a point that was not placed, or a measurement without a value
        points = _slicer_points(content, path) if "markups" in content else _plain_points(content, path, example)
    found = []
    for number, point in enumerate(points, 1):
        name = str(point.label).strip() if isinstance(point.label, str | int | float) else ""
        signs = torch.tensor(_signs(point.space, f"{path}, coordinate system"), dtype=torch.float64)
        told = _told(name) if name else f"point {number} (no name)"
        found.append((name, _point(point.position, f"{path}, {point.line}{told}") * signs))
    return found


def read_path_points(path: Path) -> tuple[Tensor, Tensor | None]:
    """Entry point (3,) and target (3,), or None, of a planned path, LPS mm, from a file of points or a line.

    Points whose names hold `entry` or `target` are these; of two points of which one is named so the other is the other
    end. Of a file without such names the first point is the entry point and the second, if there is one, the target, as
    the ends of a line of 3D Slicer are. Raises `InputError` for other numbers of points.
    """
    path = Path(path)
    points = _points(path, "entry")
    entries = [point for name, point in points if "entry" in name.lower()]
    targets = [point for name, point in points if "target" in name.lower()]
    if not entries and not targets and len(points) in (1, 2):
        entries, targets = [points[0][1]], [point for _, point in points[1:]]
    elif len(points) == 2 and len(entries) + len(targets) == 1:  # one end of a line was renamed
        named = (entries or targets)[0]
        other = [point for _, point in points if point is not named]
        entries, targets = entries or other, targets or other
    if len(entries) != 1 or len(targets) > 1:
        names = ", ".join(name or "(no name)" for name, _ in points) or "none"
        raise InputError(
            f"{path}: a line, or points named `entry` and `target`, were expected; found {len(points)} points: "
            f"{names[:120]}. Rename them in 3D Slicer."
        )
    return entries[0], targets[0] if targets else None


def write_landmarks(path: Path, landmarks: Mapping[str, Tensor]) -> None:
    """Write landmarks (3,) in LPS mm: 3D Slicer markups where `path` ends in `.mrk.json`, the plain format else."""
    if Path(path).name.endswith(".mrk.json"):
        points = [
            {"id": str(n + 1), "label": name, "position": point, "positionStatus": "defined"}
            for n, (name, point) in enumerate(landmarks.items())
        ]
        markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
        schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json"
        write_json(Path(path), {"@schema": schema + "#", "markups": [markup]})
    else:
        write_json(Path(path), {"space": "LPS", "unit": "mm", "landmarks": dict(landmarks)})


def check_inside(landmarks: Mapping[str, Tensor], volume: Volume) -> None:
    """Raises `InputError` for the first landmark (3,) in LPS mm that lies outside the grid of `volume`."""
    index_from_lps = torch.linalg.inv(volume.lps_from_index)
    size = torch.tensor(volume.data.shape[::-1], dtype=torch.float64)
    for name, point in landmarks.items():
        index = index_from_lps[:3, :3] @ point + index_from_lps[:3, 3]
        if (index < -0.5).any() or (index > size - 0.5).any():
            position = ", ".join(f"{v:.1f}" for v in point.tolist())
            raise InputError(
                f"landmark {_told(name)} at ({position}) mm LPS lies outside the CT. Check for RAS/LPS mix-ups, or "
                "that both files are of the same scan; if the CT was cropped, take the landmark out of its file."
            )
