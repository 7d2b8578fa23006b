"""Statistics of a study's records: errors over all runs, and whether wrong runs are flagged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.study.quantities import QUANTITIES, Quantity

Record = dict[str, Any]

WRONG_MM, WRONG_DEG = 4.0, 2.0  # beyond these a pose that says it can be trusted does harm
OBJECTS = ("pelvis", "femur", "device")


def outcome(record: Record) -> Record:
    """Whether a record that was made is one of a refusal, and why."""
    refused = record["refused"]
    return {"status": "done" if refused is None else "refused", "reason": refused or ""}


@dataclass(frozen=True)
class Statistics:
    """Of one quantity. Runs that were refused have no error: they count as infinitely far off in median and maximum.

    No finite mean can hold them, so mean and deviation are those of the `count` runs that gave an error.
    """

    count: int
    mean: float
    deviation: float
    median: float
    maximum: float


def statistics(records: Sequence[Record], quantity: Quantity) -> Statistics:
    """Over all records; every value is nan where no run gave an error."""
    values = np.array([quantity.of(record["errors"]) for record in records if record["refused"] is None])
    values = values[~np.isnan(values)]
    refused = sum(record["refused"] is not None for record in records)
    if len(values) == 0:
        return Statistics(0, *[float("nan")] * 4)
    everything = np.concatenate([values, np.full(refused, np.inf)])
    deviation = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    return Statistics(
        len(values), float(values.mean()), deviation, float(np.median(everything)), float(everything.max())
    )


@dataclass(frozen=True)
class Confusion:
    """Right and wrong results against whether they said that they can be trusted."""

    right_trusted: int
    right_flagged: int
    wrong_trusted: int
    wrong_flagged: int


def asked(record: Record) -> list[str]:
    """The objects that the images of a case show, so that a run should find them."""
    return record.get("asked", list(OBJECTS))


def relative_is_wrong(record: Record) -> bool:
    """Whether entry point and guide tip are more than 4 mm from where they should be to each other, or not known."""
    if record["refused"] is None and not {"femur", "device"} <= {*asked(record)}:
        return False
    return record["refused"] is not None or not record["errors"]["relative_mm"] <= WRONG_MM


def object_is_wrong(record: Record, name: str) -> bool:
    """Whether the pose of an object is off by more than 4 mm or 2°, or is not known."""
    if record["refused"] is not None:
        return True
    row = record["errors"].get(name)
    return row is None or not (row["mm"] <= WRONG_MM and row["deg"] <= WRONG_DEG)


def run_is_wrong(record: Record) -> bool:
    """Whether any object, or entry point against guide tip, is wrong."""
    return relative_is_wrong(record) or any(object_is_wrong(record, name) for name in asked(record))


def confusion(records: Sequence[Record], name: str | None = None) -> Confusion:
    """Of whole runs, or of one object. A refused run is wrong, and flagged: it gave no pose to trust."""
    counts = {(wrong, trusted): 0 for wrong in (False, True) for trusted in (False, True)}
    for record in records:
        if name is not None and name not in asked(record):
            continue
        if name is None:
            wrong, trusted = run_is_wrong(record), record["trusted"]
        else:
            wrong = object_is_wrong(record, name)
            trusted = record["refused"] is None and record["quality"].get(name, {}).get("trusted", False)
        counts[wrong, bool(trusted)] += 1
    return Confusion(counts[False, True], counts[False, False], counts[True, True], counts[True, False])


@dataclass(frozen=True)
class Coverage:
    """Shares of errors within one and two of the standard deviations that the results state, along IS, LR and AP."""

    within_1: tuple[float, ...]
    within_2: tuple[float, ...]


def coverage(records: Sequence[Record]) -> list[tuple[str, str, Coverage]]:
    """Of every object, in `mm` and `deg`, over the runs that gave a pose of it."""
    found = []
    for name in OBJECTS:
        given = [r for r in records if r["refused"] is None and name in r["errors"] and name in r["quality"]]
        for kind, key in (("mm", "translation_deviation_mm"), ("deg", "rotation_deviation_deg")):
            if not given:
                continue
            errors = np.abs([record["errors"][name][f"{kind}_xyz"] for record in given])
            # Errors are told along IS, LR and AP, deviations along the camera's −y, x and z.
            stated = np.array([record["quality"][name][key] for record in given])[:, [1, 0, 2]]
            one, two = (tuple((errors <= times * stated).mean(0).tolist()) for times in (1, 2))
            found.append((name, kind, Coverage(one, two)))
    return found


@dataclass(frozen=True)
class StageCost:
    """What one step of a plan costs, per run: sums over the views that it is run on."""

    name: str
    evaluations: float  # mean
    seconds: float  # median


def stage_costs(records: Sequence[Record]) -> list[StageCost]:
    """In the order of the plan, over the runs that were not refused."""
    sums: dict[str, dict[int, tuple[int, float]]] = {}
    for number, record in enumerate(records):
        for stage in record.get("stages", ()):
            runs = sums.setdefault(stage["name"], {})
            evaluations, seconds = runs.get(number, (0, 0.0))
            runs[number] = (evaluations + stage["evaluations"], seconds + stage["seconds"])
    return [
        StageCost(name, float(np.mean([e for e, _ in runs.values()])), float(np.median([s for _, s in runs.values()])))
        for name, runs in sums.items()
    ]


def rows_of_csv(records: Sequence[Record]) -> list[dict[str, Any]]:
    """One flat row per run: procedure, verdict, all errors (signed along each axis too), start errors and times."""
    rows = []
    for record in records:
        row = {
            key: record[key] for key in ("number", "kind", "patient", "side", "seed", "preset", "trusted", "refused")
        }
        row["reason"] = "; ".join(record["reasons"])
        row |= flat_errors(record.get("errors", {})) | flat_errors(record.get("start_errors", {}), "start_")
        row |= flat_stages(record.get("stages", ()))
        row |= {f"seconds_{key}": value for key, value in record.get("timings_s", {}).items()}
        rows.append(row)
    return rows


def flat_errors(errors: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Errors by name and unit, those of poses signed along each axis too."""
    row: dict[str, float] = {}
    for key, value in errors.items():
        if not isinstance(value, dict):
            row[f"{prefix}{key}"] = value
            continue
        for unit in ("mm", "deg"):
            row[f"{prefix}{key}_{unit}"] = value[unit]
            for axis, part in zip(("is", "lr", "ap"), value[f"{unit}_xyz"], strict=True):
                row[f"{prefix}{key}_{unit}_{axis}"] = part
    return row


def flat_stages(stages: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Evaluations and seconds of every step, and of every view that it is run on."""
    row: dict[str, float] = {}
    for stage in stages:
        name = stage["name"].replace(" ", "_") + ("" if stage["view"] is None else f"_view{stage['view']}")
        row |= {f"evaluations_{name}": stage["evaluations"], f"seconds_{name}": stage["seconds"]}
    return row


def all_quantities(records: Sequence[Record]) -> list[tuple[Quantity, Statistics]]:
    """Every quantity with its statistics."""
    return [(quantity, statistics(records, quantity)) for quantity in QUANTITIES]
