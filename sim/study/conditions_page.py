"""What procedures imaged under other conditions cost: one table for each, and one that compares them."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from femoreg_torch.files import write_json
from sim.study.accuracy import write_csv
from sim.study.conditions import Condition
from sim.study.page import machine, number, table, write_section
from sim.study.quantities import QUANTITIES
from sim.study.summary import OBJECTS, Record, all_quantities, confusion, coverage, rows_of_csv, statistics

_COMPARED = ("pelvis", "femur", "device", "C-arm view 2", "C-arm view 3", "guide tip", "entry point to tip")
_WITH_ROTATION = ("femur", "device")
_AXES = ("IS", "LR", "AP")
Run = tuple[Condition, Sequence[Record]]


def write_conditions(
    runs: Sequence[Run], preset: str, first: int | None, command: str, out: Path, docs: Path | None
) -> str:
    """Write runs and statistics of every condition into `out`, and the section into `docs`, if given; returns it.

    The section is that of the `first` so many procedures; others keep theirs.
    """
    for condition, records in runs:
        folder = out / condition.name
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / "runs.csv", rows_of_csv(records))
        found = {"/".join(quantity.path): asdict(of) for quantity, of in all_quantities(records)}
        covered = {f"{name}/{kind}": asdict(of) for name, kind, of in coverage(records)}
        write_json(folder / "summary.json", {"preset": preset, "statistics": found, "coverage": covered})
    text = section(runs, preset, command)
    if docs:
        some = "" if first is None else f", first {first} procedures"
        write_section(docs, f"Conditions: `{preset}`{some}", text)
    return text


def section(runs: Sequence[Run], preset: str, command: str) -> str:
    """The Markdown of all conditions."""
    codes = {record["code"] for _, records in runs for record in records}
    return "\n\n".join(
        [
            f"`{command}`: simulated procedures imaged again under the conditions of `configs/study/conditions.yaml`, "
            f"and registered by `{preset}`. Means over all runs that gave poses, mm and degrees.",
            *([f"**The runs come from {len(codes)} versions of the code.**"] if len(codes) > 1 else []),
            _comparison(runs),
            *(part for run in runs for part in _of_one(*run)),
            f"Measured on: {machine()}",
        ]
    )


def _comparison(runs: Sequence[Run]) -> str:
    shown = [q for q in QUANTITIES if q.name in _COMPARED or q.name in [f"{n}, rotation" for n in _WITH_ROTATION]]
    header = ("condition", "runs", *(f"{q.name}, {q.unit}" for q in shown), "right, flagged", "**wrong, trusted**")
    rows = []
    for condition, records in runs:
        counts = confusion(records)
        means = [number(statistics(records, quantity).mean) for quantity in shown]
        right = counts.right_trusted + counts.right_flagged
        told = [f"{counts.right_flagged} of {right}", str(counts.wrong_trusted)]
        rows.append([condition.name, str(len(records)), *means, *told])
    return table(header, rows)


def _of_one(condition: Condition, records: Sequence[Record]) -> list[str]:
    rows = [
        [
            f"{quantity.name}, {quantity.unit}",
            number(quantity.paper),
            f"**{number(found.mean)}** ± {number(found.deviation)}",
            number(found.median),
            number(found.maximum),
        ]
        for quantity, found in all_quantities(records)
    ]
    flagged = [record for record in records if not record["trusted"]]
    counts = confusion(records)
    told = (
        f"Of {counts.right_trusted + counts.right_flagged} right runs {counts.right_flagged} are flagged; of "
        f"{counts.wrong_trusted + counts.wrong_flagged} wrong ones **{counts.wrong_trusted}** are trusted. The device "
        f"is trusted in {confusion(records, 'device').right_trusted} runs."
    )
    reasons = [
        f"- {record['number']}: {record['patient']}, {record['side']}: "
        + (record["refused"].split("/")[-1] if record["refused"] is not None else "; ".join(record["reasons"]))
        for record in flagged
    ]
    return [
        f"### {condition.name}",
        table(("mean error", "paper", "mean ± sd", "median", "max"), rows),
        told,
        *(["\n".join(reasons)] if reasons else []),
        _coverage(records),
    ]


def _coverage(records: Sequence[Record]) -> str:
    """How many errors lie within one and two of the standard deviations that the results state."""
    rows = [
        [f"{name}, {kind}", *(f"{100 * a:.0f}, {100 * b:.0f}" for a, b in zip(of.within_1, of.within_2, strict=True))]
        for name, kind, of in coverage(records)
    ]
    header = (f"% of errors within 1 and 2 stated deviations, {len(OBJECTS)} objects", *_AXES)
    return table(header, rows) if rows else ""
