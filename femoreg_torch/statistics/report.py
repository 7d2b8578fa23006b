"""The report of a study: one HTML file with its tables, figures, worst cases, and every run that is not trusted."""

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path

import pandas as pd

from femoreg_torch.files import write_text
from femoreg_torch.statistics.figures import Picture
from femoreg_torch.statistics.formats import Table, html, number, percent
from femoreg_torch.statistics.limit_tables import read_bounds
from femoreg_torch.statistics.outcome import WRONG_MM, run_is_wrong, told
from femoreg_torch.statistics.page import cards, folded, image, listing, page
from femoreg_torch.statistics.quantities import BY_COLUMN, RELATIVE, Quantity
from femoreg_torch.statistics.rows import DONE, FAILED, REFUSED, SECONDS, VERSION, run_name, source
from femoreg_torch.statistics.study import (
    Progress,
    read_study,
    study_tables,
    trials,
    write_study_figures,
    write_study_tables,
)
from femoreg_torch.statistics.summary import confusion, statistics, trusted_runs, within

REPORT_NAME, OVERLAYS = "report.html", "overlays"
_WORST = 12  # cases shown
_AT_A_GLANCE = tuple(
    BY_COLUMN[column]
    for column in (
        "relative_mm",
        "entry_point_mm",
        "tip_mm",
        "femur_mm",
        "device_mm",
        "pelvis_mm",
        "path_deg",
        "guide_deg",
    )
)
_WORST_COLUMNS = ("relative_mm", "femur_mm", "femur_deg", "device_mm", "device_deg", "pelvis_mm")
_NOTICE = "Research software, not a medical device: its output must not guide the treatment of a patient."
_SIMULATED = (
    "The procedures are simulated, and so is the truth that errors are measured against; anatomy may be synthetic. The "
    "paper's values beside them are those of its 1,000 simulations, of another anatomy in another simulator."
)


def write_report(folder: Path, seed: int, report: Progress) -> None:
    """Write the tables, the figures and the report of the study in `folder`; `seed` is that of the bootstrap.

    Raises `InputError` if its runs cannot be read.
    """
    rows = read_study(folder)
    report("tables", 0.0)
    tables = study_tables(rows, seed, read_bounds(folder))
    of_trials = trials(folder)
    write_study_tables(folder, {**tables, "": [*tables[""], *of_trials]})
    pictures = write_study_figures(rows, folder, report)
    write_text(folder / REPORT_NAME, report_page(rows, tables, of_trials, pictures, folder / OVERLAYS))


def report_page(
    rows: pd.DataFrame,
    tables: Mapping[str, Sequence[Table]],
    of_trials: Sequence[Table],
    pictures: Mapping[str, Sequence[Picture]],
    overlays: Path,
) -> str:
    """The text of the report. `tables` are those of `study_tables`, `pictures` those of every group of runs.

    `overlays` is the folder in which there may be a picture NAME.jpg of a run.
    """
    name = ", ".join(sorted(set(rows["study"])))
    first, *others = pictures
    notice = _NOTICE if source(rows) == "recorded" else f"{_NOTICE} {_SIMULATED}"
    parts = [f"<h1>Study {escape(name)}</h1>", f'<p class="notice">{escape(notice)}</p>', _glance(rows)]
    parts += [html(tables[""][0])] if others else []
    parts += [html(table) for table in of_trials]
    parts += ["<h2>Tables</h2>", *map(html, tables[first]), "<h2>Figures</h2>", *map(_figure, pictures[first])]
    if others:
        parts.append("<h2>Conditions</h2>")
        parts += [folded(other, [*map(html, tables[other]), *map(_figure, pictures[other])]) for other in others]
    parts += ["<h2>Worst cases</h2>", *_worst(rows, overlays), "<h2>Runs that are not trusted</h2>", *_untrusted(rows)]
    parts += ["<h2>Configuration and versions</h2>", *_made_with(rows)]
    return page(f"FemoReg Torch: study {name}", parts)


def _glance(rows: pd.DataFrame) -> str:
    counts = {status: int(rows["status"].eq(status).sum()) for status in (DONE, REFUSED, FAILED)}
    trusted, right, whole = trusted_runs(rows), within(rows, RELATIVE.column, WRONG_MM), confusion(rows)
    assert whole is not None  # of whole runs there always is one
    kinds = ", ".join(f"{status} {count}" for status, count in counts.items())
    entries = [
        (f"{source(rows)} runs", str(len(rows)), kinds),
        ("trusted", percent(trusted.share), f"{trusted.met} of {trusted.of}"),
        (f"{RELATIVE.name} ≤ {WRONG_MM:g} mm", percent(right.share), f"{right.met} of {right.of}"),
        ("wrong, yet trusted", str(whole.wrong_trusted), f"of {whole.harm.of} trusted"),
        *(_median(rows, quantity) for quantity in _AT_A_GLANCE if statistics(rows, quantity.column).asked),
        *_throughput(rows),
    ]
    return cards(entries)


def _median(rows: pd.DataFrame, quantity: Quantity) -> tuple[str, str, str]:
    median = statistics(rows, quantity.column).median
    unit = "°" if quantity.unit == "°" else " mm"
    value = number(median, quantity.digits)
    return f"{quantity.name}, median", f"{value}{unit}", f"paper {quantity.paper.median:.2f}{unit}"


def _throughput(rows: pd.DataFrame) -> Iterator[tuple[str, str, str]]:
    for column, what in ((f"{SECONDS}run", "a run takes"), (f"{SECONDS}total", "a registration takes")):
        if column in rows and not math.isnan(median := float(rows[column].median())):
            hosts = rows["host"].nunique() if "host" in rows else 0
            where = f", {hosts} machine{'s' if hosts > 1 else ''}" if hosts else ""
            yield f"{what}, median", f"{median:.1f} s", f"{3600 / median:.0f} an hour and process{where}"


def _figure(picture: Picture) -> str:
    return f"<h3>{escape(picture.title)}</h3>" + image(picture.png, picture.title, picture.caption)


def _worst(rows: pd.DataFrame, overlays: Path) -> Iterator[str]:
    """The runs with the largest relative error, or where none has one, with the largest error of any object."""
    largest = told(rows, RELATIVE.column)
    what = RELATIVE.name
    if largest.isna().all():
        objects = [told(rows, column) for column in ("pelvis_mm", "femur_mm", "device_mm")]
        largest, what = pd.concat(objects, axis=1).max(axis=1), "any object"
    chosen = rows.loc[largest.dropna().sort_values(ascending=False, kind="stable").index[:_WORST]]
    if chosen.empty:
        yield "<p>No run has an error.</p>"
        return
    wrong = run_is_wrong(rows)
    quantities = [BY_COLUMN[column] for column in _WORST_COLUMNS if told(chosen, column).notna().any()]
    columns = ["run", "patient", "side", "seed", *(q.label for q in quantities), "", "why it is not trusted"]
    lines = []
    for place, row in chosen.iterrows():
        values = [number(abs(float(row[q.column])), q.digits) for q in quantities]
        verdict = f"{'wrong' if wrong[place] else 'right'}, {'trusted' if row['trusted'] else 'flagged'}"
        lines.append([run_name(row), row["patient"], row["side"], str(row["seed"]), *values, verdict, row["reasons"]])
    chosen_by = f"The {len(chosen)} runs with the largest error of {what}, refused and failed ones aside."
    yield f'<p class="note">{escape(chosen_by)}</p>'
    yield listing(columns, lines)
    for _, row in chosen.iterrows():
        path = overlays / f"{run_name(row)}.jpg"
        if path.is_file():
            caption = f"{run_name(row)}: images with the result's edges."
            yield image(path.read_bytes(), f"overlays of {run_name(row)}", caption, "jpeg")


def _untrusted(rows: pd.DataFrame) -> Iterator[str]:
    """How often each reason is given, then every run."""
    chosen = rows[~rows["trusted"]]
    if chosen.empty:
        yield "<p>There are none: every run gave a result that says it can be trusted.</p>"
        return
    wrong = run_is_wrong(rows)
    outcomes = chosen["status"].where(chosen["status"].ne(DONE), "flagged")
    reasons = chosen["reason"].where(chosen["reason"].ne(""), chosen["reasons"])
    kinds = reasons.str.replace(r"\S*/\S*[^\s:;,.]|\d[\d.,]*", "…", regex=True)  # the same with other files and numbers
    counts = pd.DataFrame({"outcome": outcomes, "reason": kinds}).value_counts()
    yield "<h3>How often, and why</h3>"
    yield listing(("runs", "", "reason"), [(str(count), *map(str, key)) for key, count in counts.items()])
    lines = []
    for place, row in chosen.iterrows():
        judged = "" if row["status"] != DONE else "wrong" if wrong[place] else "right"
        relative = number(float(told(rows, RELATIVE.column)[place]), RELATIVE.digits)
        case = f"{row['patient']} {row['side']}"
        lines.append((run_name(row), case, outcomes[place], judged, relative, reasons[place]))
    columns = ("run", "patient", "", "", RELATIVE.label, "reason")
    yield folded(f"All {len(chosen)} of {len(rows)} runs", [listing(columns, lines)])


def _made_with(rows: pd.DataFrame) -> Iterator[str]:
    """Every value of what the runs were made with, and how many runs have it."""
    columns = ["preset", "code", "kind", "settings", *(["host"] if "host" in rows else [])]
    columns += sorted(column for column in rows if column.startswith(VERSION))
    lines = []
    for column in columns:
        counts = rows[column].astype(object).where(rows[column].notna(), "–").value_counts(sort=True)
        told_values = "; ".join(
            f"{value} ({count})" if len(counts) > 1 else str(value) for value, count in counts.items()
        )
        lines.append((column.removeprefix(VERSION), told_values))
    if rows["code"].nunique() > 1:
        yield '<p class="bad">The runs come from several versions of the code.</p>'
    yield listing(("", "runs in parentheses, where they differ"), lines)
