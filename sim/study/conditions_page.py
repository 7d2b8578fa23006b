"""The section of `docs/accuracy.md` on procedures imaged under other conditions: a table of all, and one for each."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from femoreg_torch.statistics.formats import number, pipe_table
from femoreg_torch.statistics.quantities import AXES, BY_COLUMN, OBJECTS, QUANTITIES
from femoreg_torch.statistics.summary import confusion, coverage, statistics
from sim.study.accuracy_page import error_cells, procedure_name, versions_told, why
from sim.study.page import machine, write_section

_COMPARED = (
    "pelvis_mm", "femur_mm", "femur_deg", "device_mm", "device_deg", "view2_mm", "view3_mm", "tip_mm", "relative_mm",
)  # fmt: skip


def write_conditions(
    rows: pd.DataFrame, names: Sequence[str], preset: str, first: int | None, command: str, docs: Path | None
) -> str:
    """Put the section of these conditions into `docs`, if given; returns it.

    The section is that of the `first` so many procedures; others keep theirs.
    """
    text = section({name: rows[rows["condition"].eq(name)] for name in names}, preset, command)
    if docs:
        some = "" if first is None else f", first {first} procedures"
        write_section(docs, f"Conditions: `{preset}`{some}", text)
    return text


def section(runs: dict[str, pd.DataFrame], preset: str, command: str) -> str:
    """The Markdown of all conditions, the runs of each by its name."""
    parts = [
        f"`{command}`: simulated procedures imaged again under the conditions of `configs/study/conditions.yaml`, "
        f"and registered by `{preset}`. Means over all runs that gave poses, mm and degrees.",
        versions_told(pd.concat(runs.values())),
        _comparison(runs),
        *(part for name, rows in runs.items() for part in _of_one(name, rows)),
        f"Measured on: {machine()}",
    ]
    return "\n\n".join(part for part in parts if part)


def _comparison(runs: dict[str, pd.DataFrame]) -> str:
    labels = [BY_COLUMN[column].label for column in _COMPARED]
    header = ("condition", "runs", *labels, "right, flagged", "**wrong, trusted**")
    lines = []
    for name, rows in runs.items():
        counts = confusion(rows)
        assert counts is not None  # of whole runs there always is one
        means = [number(statistics(rows, column).mean, 2) for column in _COMPARED]
        right = counts.right_trusted + counts.right_flagged
        lines.append([name, str(len(rows)), *means, f"{counts.right_flagged} of {right}", str(counts.wrong_trusted)])
    return pipe_table(header, lines)


def _of_one(name: str, rows: pd.DataFrame) -> list[str]:
    header = ("mean error", "paper", "mean ± sd", "median", "max")
    counts, device = confusion(rows), confusion(rows, "device")
    assert counts is not None  # of whole runs there always is one
    trusted = 0 if device is None else device.right_trusted
    sentence = (
        f"Of {counts.right_trusted + counts.right_flagged} right runs {counts.right_flagged} are flagged; of "
        f"{counts.wrong_trusted + counts.wrong_flagged} wrong ones **{counts.wrong_trusted}** are trusted. The device "
        f"is trusted in {trusted} runs."
    )
    flagged = [f"- {procedure_name(row)}: {why(row)}" for _, row in rows[~rows["trusted"]].iterrows()]
    return [
        f"### {name}",
        pipe_table(header, [error_cells(rows, quantity.column) for quantity in QUANTITIES]),
        sentence,
        "\n".join(flagged),
        _coverage(rows),
    ]


def _coverage(rows: pd.DataFrame) -> str:
    """How many errors lie within one and two of the standard deviations that the results state."""
    lines = [
        [
            f"{found.object}, {found.unit}",
            *(f"{100 * a.share:.0f}, {100 * b.share:.0f}" for a, b in zip(found.within_1, found.within_2, strict=True)),
        ]
        for found in coverage(rows)
    ]
    axes = [axis.upper() for axis in AXES]
    header = (f"% of errors within 1 and 2 stated deviations, {len(OBJECTS)} objects", *axes)
    return pipe_table(header, lines) if lines else ""
