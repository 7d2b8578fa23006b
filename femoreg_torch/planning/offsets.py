"""What a plan is worth when it is carried out some mm or degrees beside, and under errors of registration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from femoreg_torch.case import RESULT_NAME, Case, Result, read_case, read_result
from femoreg_torch.case.femoroplasty import femoral_head
from femoreg_torch.case.model import Side
from femoreg_torch.case.reading import CASE_NAME
from femoreg_torch.delimited import read_csv
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.path import Ellipsoid, Path, Surroundings
from femoreg_torch.planning.prepare import Prepared
from femoreg_torch.text import read_bytes

Array = NDArray[np.float64]

_SAME_HEAD_MM = 1.0  # a landmark of one CT that was placed once
_MOST_BYTES = 2**16  # of a covariance as text
_OTHER_SIDE = {"left": "right", "right": "left"}
_NO_SIDE = ("", "nan", "none")  # as tables hold what is not told
_MIRRORED = np.array([-1.0, 1, 1, 1, -1, -1])  # a shift, then a turn, of LPS, seen in a mirror of left and right
_AXES = ("lr", "ap", "is")  # of a study's signed columns, as LPS: to the left, to the back, to the head


@dataclass(frozen=True)
class Outcome:
    """A plan carried out beside its place."""

    offset_mm: tuple[float, float, float]  # LPS, at the entry point
    turn_deg: tuple[float, float, float]  # about the axes of LPS through the entry point
    yield_load_n: float
    clearance_mm: float  # of the path to the surface, but near the entry; below 0 it leaves the bone
    cement_ml: float


def directions(side: Side) -> dict[str, Array]:
    """Unit vectors (3,), LPS, of the six directions, in the patient."""
    medial = np.array([-1.0 if side == "left" else 1.0, 0, 0])
    front, up = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
    return {
        "superior": up, "inferior": -up, "anterior": front, "posterior": -front, "medial": medial, "lateral": -medial
    }  # fmt: skip


def turned_ends(path: Path, distance_mm: float) -> dict[str, Array]:
    """Moves (6,) that leave the entry point and bring the path's end a distance up, down, to the front and to the back.

    Square to the path, as seen along it.
    """
    up, front = end_axes(path.entry, path.target)
    ways = {"end superior": up, "end inferior": -up, "end anterior": front, "end posterior": -front}
    angle = math.degrees(distance_mm / path.length_mm)
    return {name: np.concatenate([np.zeros(3), angle * np.cross(path.direction, way)]) for name, way in ways.items()}


def end_axes(entry: Array, target: Array) -> tuple[Array, Array]:
    """Unit vectors (3,), LPS, square to a path: the one that points most to the head, and that to the front."""
    along = (target - entry) / np.linalg.norm(target - entry)
    up = np.array([0, 0, 1.0]) - along[2] * along
    up = up / np.linalg.norm(up)
    front = np.cross(along, up)
    return up, front * (-1 if front[1] > 0 else 1)


def moved_by(entry: Array, move: Array) -> Array:
    """The motion (4, 4) of LPS space: a turn about the entry point by degrees move[3:], then a shift by mm move[:3]."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec(move[3:], degrees=True).as_matrix()
    found[:3, 3] = entry - found[:3, :3] @ entry + move[:3]
    return found


def carried_out(
    prepared: Prepared,
    around: Surroundings,
    path: Path,
    cement: Array,
    move: Array,
    moves: Literal["path", "pattern"],
) -> Outcome:
    """The plan moved (6,): by mm, LPS, and turned about its entry point by degrees about the axes of LPS.

    path: the path is moved, and cement spreads from it anew. pattern: the cement (X, Y, Z) itself is moved, and what
    would come to lie outside the marrow is lost. Raises `NoMarrowError` where a moved injection finds no marrow.
    """
    motion = moved_by(path.entry, move)
    entry, target = (motion[:3, :3] @ point + motion[:3, 3] for point in (path.entry, path.target))
    moved = Path(entry, target, tuple(Ellipsoid(**vars(e)) for e in path.ellipsoids))
    if moves == "pattern":
        affine = prepared.bone.femur.lps_from_index
        back = np.linalg.inv(affine) @ np.linalg.inv(motion) @ affine
        there = ndimage.affine_transform(cement, back[:3, :3], back[:3, 3], order=1, mode="constant")
        there = there * prepared.bone.marrow
    else:
        there = diffuse(prepared.bone, moved.injections(), prepared.planning.diffusion)
    load = prepared.curve(there).yield_load_n
    clearance = around.clearances(moved, prepared.planning.path).cortex_mm
    x, y, z, a, b, c = (float(v) for v in move)
    return Outcome((x, y, z), (a, b, c), load, clearance, prepared.bone.cement_ml(there))


def normal_moves(mean: Array, covariance: Array, draws: int, seed: int) -> Array:
    """Random moves (draws, 6) of a normal distribution: mm along LPS at the entry point, then degrees about LPS.

    Mean and covariance are of 6 values, or of 3 for mm alone. Raises `InputError` for what is no covariance.
    """
    mean, covariance = np.asarray(mean, float), np.asarray(covariance, float)
    count = len(covariance)
    if count not in (3, 6) or covariance.shape != (count, count):
        found = " × ".join(map(str, covariance.shape)) or "one number"
        raise InputError(
            f"covariance: 3 × 3 (mm², LPS) or 6 × 6 numbers (mm, then degrees) were expected, found {found}."
        )
    if not np.isfinite(covariance).all():
        raise InputError("covariance: holds a value that is infinite or no number.")
    if mean.shape != (count,) or not np.isfinite(mean).all():
        raise InputError(f"mean: {count} numbers were expected, as many as the covariance has rows, found {mean.size}.")
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() < -1e-9:
        raise InputError("covariance: is not symmetric, or has a direction of variance below 0.")
    drawn = np.zeros((draws, 6))
    drawn[:, :count] = np.random.default_rng(seed).multivariate_normal(mean, covariance, size=draws)
    return drawn


def read_covariance(file: File) -> Array:
    """The covariance in a text file (rows of numbers, with spaces or commas between) or a registration's result.json.

    In a result it is `path_covariance`, of mm and degrees. Raises `InputError` for a file that holds neither, and for a
    result that is not trusted: what it says of its uncertainty does not hold.
    """
    file = File(file)
    if file.name == RESULT_NAME:
        return _covariance_of(read_result(file.parent), file)
    if file.suffix.lower() == ".json" and file.exists():
        raise InputError(f"{file}: a result is read by its name. Call it {RESULT_NAME}, in a folder of its own.")
    text = read_bytes(file, _MOST_BYTES).decode("utf-8-sig", "replace")
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        cells = line.replace(",", " ").split()
        try:
            values = [float(cell) for cell in cells]
        except ValueError as error:
            raise InputError(
                f"{file}, line {number}: numbers were expected, found {shortened(line.strip())}."
            ) from error
        if rows and values and len(values) != len(rows[0]):
            raise InputError(
                f"{file}, line {number}: {len(values)} numbers were found, and {len(rows[0])} in the lines before. "
                "Write decimal points, and spaces or commas between numbers."
            )
        rows += [values] if values else []
    return np.array(rows, float)


def check_run(file: File, case: Case, side: Side) -> None:
    """Raises `InputError` where a result.json is of another side or patient than the case of a plan for that side.

    By the case that the result names, where that is still there: its side, and where its femoral head lies.
    """
    told = read_result(file.parent).case
    folder = None if told is None else file.parent / told
    if folder is None or not (folder / CASE_NAME).is_file():
        return
    of_run = read_case(folder)
    if of_run.side not in (None, side):
        raise InputError(
            f"{file}: is a registration of the {of_run.side} side, and the plan is for the {side} one. Give a "
            "registration of the plan's case."
        )
    there, here = (one.landmarks.get(femoral_head(side)) for one in (of_run, case))
    if there is not None and here is not None and (apart := float((there - here).norm())) > _SAME_HEAD_MM:
        raise InputError(
            f"{file}: is a registration of {folder.resolve()}, whose femoral head lies {apart:.0f} mm from that of the "
            "plan's case. Give a registration of the plan's case."
        )


def _covariance_of(result: Result, file: File) -> Array:
    if not result.verdict.trusted:
        raise InputError(
            f"{file}: is not trusted, so what it says of its uncertainty does not hold: "
            f"{shortened('; '.join(result.verdict.reasons), 300)}. Register again."
        )
    if result.path_covariance is None:
        raise InputError(f"{file}: has no path_covariance. Register a case with a planned path and its tool again.")
    return np.asarray(result.path_covariance.numpy(), float)


def study_moves(folder: File, side: Side, draws: int, seed: int) -> tuple[Array, int]:
    """Moves (draws, 6), mm and degrees, of a femur of that side, drawn from the runs of a study with replacement.

    Also tells how many runs they are drawn from.

    `folder` holds `runs.parquet` or `runs.csv`. A move is that by which the tool would miss after the correction that a
    run tells, the robot's own error aside: `miss_mm_lr|ap|is` at the entry point and `miss_deg_lr|ap|is` about it,
    along the axes of LPS, see `evaluation.path_miss`. Errors where the tool was imaged do not tell it: its turn error
    grows along the way to the bone. Runs of the other side are mirrored. Runs that were not trusted would not have been
    carried out, and are left out. Raises `InputError` for a missing file or column, or if no run is left.
    """
    table = _read_runs(folder)
    columns = [f"miss_{unit}_{axis}" for unit in ("mm", "deg") for axis in _AXES]
    missing = [name for name in columns if name not in table]
    if missing:
        raise InputError(
            f"{folder}: the runs have no column {missing[0]}, which tells by what a tool misses after its "
            "correction; errors where it was imaged, all that older versions kept, do not tell it. Run the study again."
        )
    try:
        values = np.array([table[name] for name in columns], float).T
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{folder}: numbers were expected in the columns {columns[0]}, … ({shortened(error)})."
        ) from error
    kept = np.isfinite(values).all(1)
    if "trusted" in table:
        kept &= np.array([str(value).lower() in ("true", "1") for value in table["trusted"]], bool)
    if not kept.any():
        raise InputError(f"{folder}: no trusted run that tells by what a corrected tool misses.")
    found = values[kept]
    if "side" in table:
        sides = np.array([str(value).strip().lower() for value in table["side"]])[kept]
        if strange := sorted(set(sides.tolist()) - {*_OTHER_SIDE, *_NO_SIDE}):
            raise InputError(f"{folder}: `side` of a run was to be left or right, found {shortened(strange[0])}.")
        other = sides == _OTHER_SIDE[side]
        found[other] *= _MIRRORED
    return np.asarray(found[np.random.default_rng(seed).integers(len(found), size=draws)]), len(found)


def _read_runs(folder: File) -> dict[str, Sequence[Any]]:
    parquet, text = File(folder) / "runs.parquet", File(folder) / "runs.csv"
    if parquet.is_file():
        from pyarrow import parquet as reader

        try:
            found: dict[str, Sequence[Any]] = reader.read_table(parquet).to_pydict()
        except (OSError, ValueError) as error:  # pyarrow's own errors are ValueErrors
            raise InputError(f"{parquet}: cannot be read as Parquet ({shortened(error)}).") from error
        return found
    if not text.is_file():
        raise InputError(f"{folder}: holds neither runs.parquet nor runs.csv. Give the folder of a study.")
    rows = read_csv(text, ())
    return {name: [row.values[name] or "nan" for row in rows] for name in rows[0].values}
