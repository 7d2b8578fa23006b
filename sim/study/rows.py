"""`runs.parquet`: the records of a study as one table, a row for each run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from femoreg_torch.evaluation.errors import paper_from_camera
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro.display import Source
from femoreg_torch.statistics.quantities import AXES
from femoreg_torch.statistics.rows import IDENTITY, ROWS_NAME, checked_rows
from sim.study.record import Record

TABLE_NAME = ROWS_NAME
_DIFFERS = ("seconds_", "host", "version_")  # what may differ between two runs of the same study
_LAST = ("evaluations_", "seconds_", "version_", "host")  # beginnings of the columns that stand at the end

Row = dict[str, Any]


def rows_of(record: Record) -> list[Row]:
    """The row of a run; of a closed loop, one for each round."""
    head: Row = {key: record[key] for key in IDENTITY}
    head |= {f"varied_{key}": value for key, value in record["varied"].items()}
    tail = {"seconds_run": record["run_s"]} if "run_s" in record else {}
    tail |= {f"version_{key}": value for key, value in record["versions"].items()} | {"host": record["host"]}
    rounds = [record | found for found in record.get("rounds", [{}])]
    return [head | _of_round(found) | tail for found in rounds]


def _of_round(record: Record) -> Row:
    row: Row = {key: record[key] for key in ("status", "reason", "trusted")}
    row["reasons"] = "; ".join(record["reasons"])
    row["asked"] = " ".join(record.get("asked", ()))
    row |= {key: record[key] for key in ("round", "before_mm", "before_deg", "left_mm", "left_deg") if key in record}
    row |= flat_errors(record.get("errors") or {}) | flat_errors(record.get("start_errors") or {}, "start_")
    if record.get("pelvis_at_head_mm") is not None:
        row["pelvis_at_head_mm"] = record["pelvis_at_head_mm"]
    for point, shift in (record.get("displacements_mm") or {}).items():
        row |= {f"{point}_mm_{axis}": part for axis, part in zip(AXES, shift, strict=True)}
    row |= flat_errors({"miss": record["miss"]} if record.get("miss") else {})
    axes = _camera_axes(record.get("source", "anterior"))
    for name, quality in record.get("quality", {}).items():
        row[f"{name}_trusted"] = quality["trusted"]
        for unit, key in (("mm", "translation_deviation_mm"), ("deg", "rotation_deviation_deg")):
            row |= {f"{name}_sigma_{unit}_{axis}": quality[key][n] for axis, n in zip(AXES, axes, strict=True)}
    row |= flat_stages(record.get("stages", ()))
    return row | {f"seconds_{key}": value for key, value in record.get("timings_s", {}).items()}


def _camera_axes(source: Source) -> list[int]:
    """Which axis of camera 1, along which deviations are told, is IS, LR and AP, along which errors are."""
    found: list[int] = paper_from_camera(source).abs().argmax(1).tolist()
    return found


def flat_errors(errors: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Errors by name and unit, those of poses signed along each axis too."""
    row: dict[str, float] = {}
    for key, value in errors.items():
        if not isinstance(value, dict):
            row[f"{prefix}{key}"] = value
            continue
        for unit in ("mm", "deg"):
            row[f"{prefix}{key}_{unit}"] = value[unit]
            row |= {f"{prefix}{key}_{unit}_{axis}": v for axis, v in zip(AXES, value[f"{unit}_xyz"], strict=True)}
    return row


def flat_stages(stages: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Evaluations and seconds of every step, and of every view that it is run on."""
    row: dict[str, float] = {}
    for stage in stages:
        name = stage["name"].replace(" ", "_") + ("" if stage["view"] is None else f"_view{stage['view']}")
        row |= {f"evaluations_{name}": stage["evaluations"], f"seconds_{name}": stage["seconds"]}
    return row


def frame_of(records: Sequence[Record]) -> pd.DataFrame:
    """The rows of records as `femoreg_torch.statistics` takes them."""
    return checked_rows(table_of(records).to_pandas(), "records")


def table_of(records: Sequence[Record]) -> pa.Table:
    """All rows, in the order of the records; a column for all that any of them tells."""
    rows = [row for record in records for row in rows_of(record)]
    names = sorted(dict.fromkeys(name for row in rows for name in row), key=_place)
    return pa.table({name: _column([row.get(name) for row in rows]) for name in names})


def _place(name: str) -> int:
    """What is told of a run, what was varied, results, costs, versions and host; in each as the rows have them."""
    if name in IDENTITY:
        return 0
    last = (place for place, start in enumerate(_LAST, 3) if name.startswith(start))
    return 1 if name.startswith("varied_") else next(last, 2)


def _column(values: list[Any]) -> pa.Array:
    """Of whole numbers, of numbers, of truth values or of text: whatever holds them all."""
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pa.array(values, pa.bool_())
    if kinds == {int}:
        return pa.array(values, pa.int64())
    if kinds <= {int, float}:
        return pa.array(values, pa.float64())
    return pa.array([value if value is None else str(value) for value in values], pa.string())


def write_table(path: Path, records: Sequence[Record]) -> pa.Table:
    """Write the table of these records, whole or not at all. Returns it."""
    table = table_of(records)
    with temporary_file(path) as part:
        pq.write_table(table, part)
    return table


def read_table(path: Path) -> pa.Table:
    """The table of a study."""
    return pq.read_table(path)


def comparable(table: pa.Table) -> list[Mapping[str, Any]]:
    """The rows without times, hosts and versions: those of two runs of the same study are equal."""
    kept = [name for name in table.column_names if not name.startswith(_DIFFERS)]
    found: list[Mapping[str, Any]] = table.select(kept).to_pylist()
    return found
