"""What a user says of beads: a YAML file that names them, and a table of their shadows."""

from dataclasses import dataclass
from pathlib import Path

import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.beads.ct import find_beads
from femoreg_torch.beads.model import Beads, check_beads, check_count
from femoreg_torch.case import Case
from femoreg_torch.case.fields import Fields
from femoreg_torch.delimited import check_decimal_marks, decimal, read_csv
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.registration.prepare.bones import read_bones
from femoreg_torch.text import read_yaml_and_lines
from femoreg_torch.volume import read_landmarks

COLUMNS = ("image", "bead", "column_px", "row_px")
IN_CT = "ct"
_BY_HAND_MM = 0.2  # deviation of a bead's centre along an axis where a person has picked it
_MOST = 1000  # beads in a bone
_AROUND_MM = 4.0  # of the bone's labels, which is searched too: a label map may leave out a bead's voxels


@dataclass(frozen=True)
class Mark:
    """A shadow that somebody has picked."""

    bead: str | None  # its name, where that is known
    pixel: tuple[float, float]  # column, row


@dataclass(frozen=True, eq=False)
class Given:
    """Beads, and what is known of their images."""

    beads: tuple[Beads, ...]
    marks: dict[str, tuple[Mark, ...]] | None  # by the name of an image; None: shadows are looked for
    noise_px: float | None  # deviation of a shadow along each axis; None: estimated
    first_view_only: bool


def read_beads(path: Path, case: Case) -> Given:
    """The beads of a case, by a YAML file; see `docs/beads.md`. Paths are relative to the file.

    Raises `InputError` that names file and key.
    """
    path = Path(path)
    content, lines = read_yaml_and_lines(path)
    top = Fields(content, str(path), lines=lines).only("objects", "annotations", "image_noise_px", "views")
    entries = top.mapping("objects")
    if not entries.content:
        raise InputError(f"{top.where('objects')}: is empty. Name at least one object with beads.")
    for name in entries.content:
        if name not in case.objects:
            raise InputError(f"{entries.where(str(name))}: the case has no such object, but {', '.join(case.objects)}.")
    # all that a file can have wrong comes before a CT is searched, which takes a while
    noise = _positive(top, "image_noise_px") if "image_noise_px" in top else None
    first = "views" in top and top.choice("views", ("all", "first")) == "first"
    told = [_told(entries.mapping(name), name, case, path.parent) for name in entries.content]
    names = [bead for thing in told for bead in thing.names]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(
            f"{top.where('objects')}: two beads are named {shortened(repeated[0])}. Give every bead its own name."
        )
    marks = read_marks(top.file_path("annotations", path.parent), names, case) if "annotations" in top else None
    return Given(tuple(_beads(thing, case) for thing in told), marks, noise, first)


@dataclass(frozen=True, eq=False)
class _Told:
    """What the file says of the beads of one object."""

    object: str
    fields: Fields
    diameter_mm: float
    names: tuple[str, ...]
    points: Tensor | None  # (N, 3) mm; None: to be found in the CT
    noise_mm: float | None


def _told(fields: Fields, name: str, case: Case, folder: Path) -> _Told:
    fields.only("points", "count", "diameter_mm", "noise_mm")
    diameter = _positive(fields, "diameter_mm")
    noise = _positive(fields, "noise_mm", or_zero=True) if "noise_mm" in fields else None
    if fields.text("points", "a file of points, or `ct`") == IN_CT:
        names = tuple(f"{name}{number}" for number in range(1, _count_in_ct(fields, name, case) + 1))
        return _Told(name, fields, diameter, names, None, noise)
    if "count" in fields:
        raise InputError(f"{fields.where('count')}: goes with `points: ct` only; a file tells by itself how many.")
    named = read_landmarks(fields.file_path("points", folder), None)
    points = torch.stack(list(named.values()))
    check_beads(points, fields.where("points"))
    return _Told(name, fields, diameter, tuple(named), points, noise)


def _beads(told: _Told, case: Case) -> Beads:
    """The beads that the file tells, those of a bone looked for in the CT."""
    if told.points is None:
        points, deviations = _in_ct(told, case)
        check_beads(points, told.fields.where("points"))
    else:
        points, deviations = told.points, torch.full((len(told.points),), _BY_HAND_MM, dtype=torch.float64)
    if told.noise_mm is not None:
        deviations = torch.full((len(points),), told.noise_mm, dtype=torch.float64)
    return Beads(told.object, told.names, points, told.diameter_mm, deviations)


def _count_in_ct(fields: Fields, name: str, case: Case) -> int:
    if case.objects[name].model is not None:
        raise InputError(
            f"{fields.where('points')}: {name} is no bone of the CT. Give a file with points in its space."
        )
    count = fields.whole("count", 1, _MOST)
    check_count(count, fields.where("count"))
    return count


def _in_ct(told: _Told, case: Case) -> tuple[Tensor, Tensor]:
    """Points (N, 3) and deviations (N,) of as many beads as the file says."""
    ct, bones = read_bones(case)
    labels = bones.of(case.objects[told.object].bones, case.anatomy)
    mask = torch.isin(bones.labels.data, torch.tensor(labels, dtype=torch.uint8))
    voxels = [round(_AROUND_MM / s) for s in ct.spacing_mm[::-1]]
    grown = torch.from_numpy(ndimage.maximum_filter(mask.numpy(), [2 * n + 1 for n in voxels]))
    return find_beads(ct, told.diameter_mm, len(told.names), grown, f"{case.ct_path}, beads of {told.object}")


def _positive(fields: Fields, key: str, or_zero: bool = False) -> float:
    value = fields.number(key)
    if value < 0 or (value == 0 and not or_zero):
        raise InputError(f"{fields.where(key)}: a positive number was expected, found {value:g}.")
    return value


def read_marks(path: Path, names: list[str], case: Case) -> dict[str, tuple[Mark, ...]]:
    """Shadows that were picked, by the file name of their image, from a CSV file with the columns of `COLUMNS`.

    `image` is the file name in the case, with or without its suffix; `bead` may be empty. Pixels count from the centre
    of the first one. Raises `InputError` that names file and line.
    """
    rows = read_csv(path, COLUMNS)
    check_decimal_marks(rows, COLUMNS[2:], str(path))
    names_of_images = [image.name for view in case.views for image in view.images.values()]
    if repeated := sorted({name for name in names_of_images if names_of_images.count(name) > 1}):
        raise InputError(
            f"{path}: two images of the case are called {shortened(repeated[0])}, and marks go by this name. Rename "
            "one."
        )
    images = {name: name for name in names_of_images}
    images |= {Path(name).stem: name for name in images}
    rows_px, columns_px = case.carm.camera.shape
    found: dict[str, list[Mark]] = {}
    for row in rows:
        line, values = row.line, row.values
        image = images.get(values["image"])
        if image is None:
            raise InputError(
                f"{path}, line {line}: the case has no image {shortened(values['image'])}, but {', '.join(images)}."
            )
        bead = values["bead"] or None
        if bead is not None and bead not in names:
            raise InputError(f"{path}, line {line}: there is no bead {shortened(bead)}, but {', '.join(names)}.")
        column, height = (
            _pixel(values[key], size, f"{path}, line {line}, {key}")
            for key, size in (("column_px", columns_px), ("row_px", rows_px))
        )
        marks = found.setdefault(image, [])
        if bead is not None and any(mark.bead == bead for mark in marks):
            raise InputError(f"{path}, line {line}: bead {bead} stands there twice for {image}. Keep one.")
        marks.append(Mark(bead, (column, height)))
    return {image: tuple(marks) for image, marks in found.items()}


def _pixel(value: str, size: int, where: str) -> float:
    try:
        number = decimal(value)
    except ValueError:
        number = float("nan")
    if not -0.5 <= number <= size - 0.5:
        raise InputError(f"{where}: a pixel of the image from 0 to {size - 1} was expected, found {shortened(value)}.")
    return number
