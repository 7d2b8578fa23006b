"""The runs of a study as rows of a Parquet file, read and checked, written whole or not at all.

One row a run. Beside the columns in `IDENTITY` and `OUTCOME` there are the errors, signed along each axis
(`femur_mm_ap`) and in total (`femur_mm`), those of the start (`start_…`), what the run states of itself
(`femur_sigma_mm_ap`, `femur_trusted`), what was varied (`varied_…`), and costs and versions (`seconds_…`,
`evaluations_…`, `version_…`, `host`). A column may be missing where no run has a value for it. Of a closed loop there
is one row for every `round`.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd
from pandas.api.types import is_object_dtype, is_scalar

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import temporary_file
from femoreg_torch.paths import check_readable
from femoreg_torch.statistics.quantities import (
    AXES,
    METRICS,
    MISSES,
    OBJECTS,
    PELVIS_AT_HEAD,
    POSE_QUANTITIES,
    QUANTITIES,
)

ROWS_NAME, TRIALS_NAME = "runs.parquet", "trials.parquet"
IDENTITY = ("study", "condition", "number", "patient", "kind", "side", "seed", "preset", "code", "settings")
PROCEDURE = ("number", "patient", "side", "seed")  # what makes two runs runs of one procedure
OUTCOME = ("status", "reason", "trusted", "reasons")
DONE, REFUSED, FAILED = "done", "refused", "failed"
VARIED, SECONDS, EVALUATIONS, VERSION = "varied_", "seconds_", "evaluations_", "version_"  # how names of columns start
ASKED = "asked"  # optional: the objects that the images show, apart by blanks
ROUND = "round"  # optional: of a closed loop, from 1
BEADS = "beads_"  # optional, of trials: what the beads themselves leave open of the error whose name follows
ALL = "all"  # what the group of all conditions is called

SIGMAS = tuple(f"{name}_sigma_{unit}_{axis}" for name in OBJECTS for unit in ("mm", "deg") for axis in AXES)
_SIGNED = tuple(q.column for rows in POSE_QUANTITIES.values() for parts in rows.values() for q in parts)
ROUNDS = (
    "before_mm",
    "before_deg",
    "left_mm",
    "left_deg",
)  # guide from path, before and after a round
_PARTS = tuple(f"{point}_mm_{axis}" for point in ("entry_point", "tip") for axis in AXES)  # optional
_MISS = tuple(q.column for q in MISSES)  # optional
_MISS_PARTS = tuple(f"{total}_{axis}" for total in _MISS for axis in AXES)
_OPEN = tuple(BEADS + q.column for q in METRICS)
NUMBERS = (
    *_SIGNED,
    *(q.column for q in METRICS),
    *_PARTS,
    *_MISS,
    *_MISS_PARTS,
    *SIGMAS,
    PELVIS_AT_HEAD,
    *ROUNDS,
    *_OPEN,
)
_NOT_NEGATIVE = {*(q.column for q in QUANTITIES), *_MISS, *SIGMAS}
_NOT_TEXT = ("number", "seed", "trusted")
_GREATEST = 1e9  # of a value of a run


def read_rows(path: Path) -> pd.DataFrame:
    """The runs in a Parquet file, ordered by condition and number.

    Raises `InputError` where the file is missing, no Parquet, without rows, lacks a column, or holds what cannot be.
    """
    check_readable(path, f"Give a folder with the runs of a study, {ROWS_NAME}.")
    try:
        rows = pd.read_parquet(path)
    except (OSError, ValueError) as error:  # pyarrow's own errors are ValueErrors
        raise InputError(f"{path}: cannot be read as Parquet ({' '.join(str(error).split())}).") from error
    return checked_rows(rows, path)


def checked_rows(rows: pd.DataFrame, where: str | Path) -> pd.DataFrame:
    """`rows` with text, truth values and numbers where they are expected, ordered by condition and number."""
    if missing := [column for column in (*IDENTITY, *OUTCOME) if column not in rows]:
        raise InputError(f"{where}: has no column {', '.join(missing)}. Is it one row per run of a study?")
    if rows.empty:
        raise InputError(f"{where}: holds no run. Let the study finish at least one.")
    if unknown := sorted(set(map(str, rows["status"])) - {DONE, REFUSED, FAILED}):
        raise InputError(
            f"{where}: status {shortened(unknown[0])} is unknown; there are {DONE}, {REFUSED} and {FAILED}."
        )
    if not any(quantity.column in rows for quantity in QUANTITIES) and rows["status"].eq(DONE).any():
        raise InputError(f"{where}: has no error in any column, as {QUANTITIES[0].column} or {QUANTITIES[-1].column}.")
    numbers = pd.to_numeric(rows["number"].where(rows["number"].map(is_scalar)), errors="coerce")
    if not (numbers % 1 == 0).all():
        raise InputError(f"{where}, column number: whole numbers were expected, one for each procedure.")
    verdicts = [c for c in rows if c == "trusted" or c in {f"{name}_trusted" for name in OBJECTS}]
    for column in verdicts:
        if words := [value for value in rows[column] if isinstance(value, str)]:
            raise InputError(f"{where}, column {column}: true or false was expected, found {shortened(words[0])}.")
    rows = rows.copy()
    for column in [c for c in rows if is_object_dtype(rows[c])]:  # columns of text hold nothing else
        rows[column] = rows[column].map(lambda value: value if is_scalar(value) else _text(value))
    for column in [c for c in (*IDENTITY, *OUTCOME, ASKED) if c in rows and c not in _NOT_TEXT]:
        rows[column] = rows[column].astype(object).where(rows[column].notna(), "").map(_text)
    for column in verdicts:
        rows[column] = rows[column].map(_is_true).astype(bool)  # what is not known to be trusted is not
    rows["trusted"] &= rows["status"].eq(DONE)
    for column in [c for c in rows if c in NUMBERS or c.startswith((SECONDS, EVALUATIONS))]:
        rows[column] = _numbers(rows, column, where)
        if column in _NOT_NEGATIVE and (rows[column] < 0).any():
            raise InputError(f"{where}, column {column}: an error or a deviation cannot be below 0.")
    keys = [*IDENTITY, ROUND] if ROUND in rows else [*IDENTITY]
    if (twice := rows.duplicated(keys)).any():
        one = rows[twice].iloc[0]
        raise InputError(
            f"{where}: run {one['number']} of condition {shortened(one['condition'])} stands there twice, with the "
            "same settings. Keep one."
        )
    return rows.sort_values(["condition", "number"], kind="stable", ignore_index=True)


def _numbers(rows: pd.DataFrame, column: str, where: str | Path) -> "pd.Series[float]":
    """A column as numbers. Raises `InputError` with the run whose value is none, or far too large for any run."""
    given = rows[column].map(lambda value: value if is_scalar(value) else str(value))
    found = pd.to_numeric(given, errors="coerce").astype(float)
    wrong = (found.isna() & given.notna()) | (found.abs() > _GREATEST)
    if wrong.any():
        run = rows["number"][wrong].iloc[0]
        what = "an infinite number" if np.isinf(found[wrong].iloc[0]) else shortened(given[wrong].iloc[0])
        raise InputError(f"{where}, column {column}: numbers were expected, and run {run} has {what}.")
    return found


def _is_true(value: object) -> bool:
    return bool(is_scalar(value) and not pd.isna(value) and value == True)  # noqa: E712  # 1 and 1.0 too, as CSV and Parquet may hold it


def _text(value: object) -> str:
    """Lists of reasons as one line."""
    return "; ".join(map(str, value)) if hasattr(value, "__iter__") and not isinstance(value, str) else str(value)


def write_rows(rows: pd.DataFrame, path: Path) -> None:
    """Write the runs of a study as Parquet, whole or not at all. Raises `InputError` for rows that none could read."""
    checked_rows(rows, path)
    with temporary_file(path) as part:
        rows.to_parquet(part, index=False)


def groups(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The runs of each condition by its name, and before them all together where there are several.

    Raises `InputError` for names that differ only in what a folder cannot be called.
    """
    found = {str(name): part for name, part in rows.groupby("condition", sort=True)}
    names = [*found, ALL] if len(found) > 1 else [*found]
    if len({folder_name(name) for name in names}) < len(names):
        raise InputError(
            f"conditions {', '.join(found)}: two would share a folder, or use that of {shortened(ALL)}. Rename them."
        )
    return {ALL: rows, **found} if len(found) > 1 else found


def procedures(rows: pd.DataFrame) -> "pd.Series[int]":
    """A number for each run that runs of one procedure share: under several conditions, or in rounds of a closed loop.

    Such runs are not independent: they have patient, poses and noise in common.
    """
    return rows.groupby(list(PROCEDURE), sort=False, dropna=False).ngroup()


def folder_name(condition: str) -> str:
    """What the folder of a condition is called: its name, with _ for anything but letters, digits, dots and −."""
    return re.sub(r"[^\w.-]+", "_", condition).strip(".") or "unnamed"


def varied(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The columns of what was varied, with the runs to compare: at least two values, None where nothing was varied.

    These are the runs that have a value, and beside them those that have none in any column that only some runs have.
    """
    columns = [column for column in rows if column.startswith(VARIED)]
    partial = [column for column in columns if rows[column].isna().any()]
    plain = rows[partial].isna().all(axis=1)
    parts = {column: rows[rows[column].notna() | plain] for column in columns}
    return {column: part for column, part in parts.items() if part[column].nunique(dropna=False) > 1}


def run_name(row: "pd.Series[object]") -> str:
    """What the run of a row is called among the files of its study."""
    return f"{row['condition']}-{int(row['number']):05d}-{str(row['settings'])[:8]}"


def source(rows: pd.DataFrame) -> str:
    """Where the images come from: simulated procedures, recorded ones, or both."""
    recorded = rows["kind"].eq("recorded")
    return "recorded" if recorded.all() else "simulated and recorded" if recorded.any() else "simulated"


def plain_name(column: str) -> str:
    """`varied_device_turn_deg` as `device turn, °`."""
    words = column.removeprefix(VARIED).split("_")
    units = {"mm": "mm", "deg": "°", "px": "px", "hu": "HU", "s": "s"}
    if len(words) > 1 and words[-1] in units:
        return f"{' '.join(words[:-1])}, {units[words[-1]]}"
    return " ".join(words)
