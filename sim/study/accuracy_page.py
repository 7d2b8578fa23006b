"""The section of `docs/accuracy.md` on the procedures as they are, registered by one preset."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pandas as pd
from matplotlib import rc_context

from femoreg_torch.files import temporary_file
from femoreg_torch.statistics.costs import stage_costs
from femoreg_torch.statistics.figures import write_figures
from femoreg_torch.statistics.figures.distributions import distributions
from femoreg_torch.statistics.figures.style import STYLE
from femoreg_torch.statistics.formats import number, pipe_table, plus_minus
from femoreg_torch.statistics.outcome import WRONG_DEG, WRONG_MM, asked, run_is_wrong, told
from femoreg_torch.statistics.quantities import OBJECTS, QUANTITIES, RELATIVE
from femoreg_torch.statistics.rows import DONE, FAILED, SECONDS
from femoreg_torch.statistics.summary import Confusion, confusion, statistics
from sim.study.page import machine, write_section
from sim.study.timing import Timing

KINDS = ("procedural", "real")
# Mean errors that the preset `fast` may have at most: what is wanted of this project, below the paper's.
WANTED = {
    "pelvis_mm": 0.45, "pelvis_deg": 0.10, "femur_mm": 0.40, "femur_deg": 0.30, "device_mm": 0.50, "device_deg": 0.12,
    "view2_mm": 0.65, "view2_deg": 0.12, "view3_mm": 0.35, "view3_deg": 0.08,
    "entry_point_mm": 0.80, "tip_mm": 0.45, "relative_mm": 0.60, "path_deg": 0.30, "guide_deg": 0.09,
}  # fmt: skip


def write_results(
    rows: pd.DataFrame, total: int, preset: str, out: Path, docs: Path | None, timing: Timing | None
) -> str:
    """Draw the figure into the folder `out`, and put it with its section into `docs`, if given. Returns the section.

    `total` is the number of procedures that the study has.
    """
    text = section(rows, total, preset, timing)
    picture = _figure(rows, preset, out)
    if docs:
        write_section(docs, f"Simulated procedures: `{preset}`", text)
        if picture is not None:
            with temporary_file(docs / f"accuracy_{preset}.png") as part:
                part.write_bytes(picture)
    return text


def _figure(rows: pd.DataFrame, preset: str, out: Path) -> bytes | None:
    """A line per kind of patient; None where no run has an error."""
    with rc_context(STYLE):
        plot = distributions(rows.assign(condition=rows["kind"]))
    if plot is None:
        return None
    return write_figures([replace(plot, name=f"accuracy_{preset}")], out)[0].png


def section(rows: pd.DataFrame, total: int, preset: str, timing: Timing | None) -> str:
    """The Markdown of one preset."""
    counts = [int(rows["kind"].eq(kind).sum()) for kind in KINDS]
    parts = [
        f"`make accuracy PRESET={preset}`: {len(rows)} of the {total} procedures ({counts[0]} on procedural patients, "
        f"{counts[1]} on real bone shapes), failures included.",
        _without_pose(rows),
        versions_told(rows),
        _errors(rows, preset),
        f"![Share of runs with an error of at most so much](accuracy_{preset}.png)",
        "Share of runs with an error of at most so much, a line per kind of patient. Dashed: the paper's mean.",
        "### Trust",
        _trust(rows),
        *_doubtful(rows),
        "### Cost",
        _cost(rows, timing),
    ]
    return "\n\n".join(part for part in parts if part)


def _without_pose(rows: pd.DataFrame) -> str:
    without = int(rows["status"].ne(DONE).sum())
    failed = int(rows["status"].eq(FAILED).sum())
    if without == 0:
        return f"All {len(rows)} runs gave poses, so means and deviations are over all of them."
    return (
        f"**{without} of {len(rows)} runs gave no pose** ({without - failed} refused, {failed} failed). They have no "
        f"error that a mean could hold: mean and deviation are over the other {len(rows) - without}, while median, "
        "maximum and all counts below take them as failures."
    )


def versions_told(rows: pd.DataFrame) -> str:
    """A sentence if the runs come from several versions of the code."""
    count = rows["code"].nunique()
    return f"**The runs come from {count} versions of the code.**" if count > 1 else ""


def _errors(rows: pd.DataFrame, preset: str) -> str:
    own = preset == "fast"
    header = ("mean error", "paper", "mean ± sd", "median", "max", "procedural", "real", "wanted", "")
    lines = []
    for quantity in QUANTITIES:
        found = statistics(rows, quantity.column)
        limit = WANTED[quantity.column] if own else quantity.paper.mean
        apart = [number(statistics(rows[rows["kind"].eq(kind)], quantity.column).mean, 2) for kind in KINDS]
        wanted = f"{'≤' if own else '<'} {number(limit, 2)}"
        lines.append([*error_cells(rows, quantity.column), *apart, wanted, "met" if found.mean <= limit else "not met"])
    return pipe_table(header, lines)


def error_cells(rows: pd.DataFrame, column: str) -> list[str]:
    """What the error is, the paper's mean, and mean, deviation, median and maximum of the runs."""
    quantity = next(q for q in QUANTITIES if q.column == column)
    found = statistics(rows, column)
    mean = plus_minus(found.mean, found.deviation, 2).replace(number(found.mean, 2), f"**{number(found.mean, 2)}**", 1)
    return [quantity.label, number(quantity.paper.mean, 2), mean, number(found.median, 2), number(found.maximum, 2)]


def _trust(rows: pd.DataFrame) -> str:
    header = ("", "right, trusted", "right, flagged", "**wrong, trusted**", "wrong, flagged")
    whole = confusion(rows)
    assert whole is not None  # of whole runs there always is one
    objects = [(name, counts) for name in OBJECTS if (counts := confusion(rows, name)) is not None]
    lines = [["whole run", *confusion_cells(whole)], *([name, *confusion_cells(counts)] for name, counts in objects)]
    far = asked(rows, RELATIVE.column) & ~(told(rows, RELATIVE.column) <= WRONG_MM)
    right = whole.right_trusted + whole.right_flagged
    share = 100 * whole.right_flagged / right if right else float("nan")
    facts = [
        f"- relative error within {WRONG_MM:g} mm: **{len(rows) - far.sum()} of {len(rows)}** (wanted: all but one in "
        f"60); of the {far.sum()} others {rows['trusted'][far].sum()} say that they can be trusted (wanted: 0)",
        f"- wrong and trusted: **{whole.wrong_trusted}** (wanted: 0)",
        f"- right runs flagged: **{whole.right_flagged} of {right}**, {number(share, 1)} % (wanted: at most 5 %)",
    ]
    meaning = (
        f"Wrong is a pose off by more than {WRONG_MM:g} mm or {WRONG_DEG:g}°; a run is wrong if any object is, or "
        f"entry point to tip by more than {WRONG_MM:g} mm."
    )
    return f"{meaning}\n\n{pipe_table(header, lines)}\n\n" + "\n".join(facts)


def confusion_cells(counts: Confusion) -> list[str]:
    """Right and wrong runs, trusted and flagged."""
    return [str(n) for n in (counts.right_trusted, counts.right_flagged, counts.wrong_trusted, counts.wrong_flagged)]


def _doubtful(rows: pd.DataFrame) -> Iterable[str]:
    """The runs that are wrong or flagged, one line each."""
    chosen = rows[run_is_wrong(rows) | ~rows["trusted"]]
    if chosen.empty:
        return []
    header = ("run", "pelvis", "femur", "device", "relative", "says", "why")
    lines = []
    for place, row in chosen.iterrows():
        done = row["status"] == DONE
        poses = [
            f"{told(rows, f'{name}_mm')[place]:.2f} mm, {told(rows, f'{name}_deg')[place]:.2f}°"
            if pd.notna(told(rows, f"{name}_mm")[place])
            else "–"
            for name in OBJECTS
        ]
        relative = f"{number(float(told(rows, RELATIVE.column)[place]), 2)} mm" if done else "–"
        says = row["status"] if not done else "trusted" if row["trusted"] else "flagged"
        lines.append([procedure_name(row), *poses, relative, says, why(row) or "–"])
    return ["Every run that is wrong or flagged:", pipe_table(header, lines)]


def procedure_name(row: "pd.Series[object]") -> str:
    """Number, patient and side."""
    return f"{row['number']}: {row['patient']}, {row['side']}"


def why(row: "pd.Series[object]") -> str:
    """Why a run is not trusted, without the folders of the machine that it was made on."""
    return str(row["reasons"] if row["status"] == DONE else str(row["reason"]).split("/")[-1])


def _cost(rows: pd.DataFrame, timing: Timing | None) -> str:
    lines = [[cost.name, number(cost.evaluations, 0), number(cost.seconds, 2)] for cost in stage_costs(rows)]
    text = [
        "Evaluations (mean; of all images of the stage together) and seconds (median) per run. The seconds were taken "
        "along the way, on one core per registration, and depend on what else the machine did.",
        pipe_table(("stage", "evaluations", "s"), lines),
    ]
    total = f"{SECONDS}total"
    if total in rows and rows[total].notna().any():
        text.append(f"Reading, detection, registration and quality together: median {rows[total].median():.1f} s.")
    if timing:
        text.append(timing.told())
    return "\n\n".join([*text, f"Measured on: {machine()}"])
