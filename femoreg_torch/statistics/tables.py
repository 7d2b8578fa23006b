"""The tables of a group of runs: the paper's Tables I and II beside its values, and what the paper does not tell."""

import math
from typing import Any

import pandas as pd

from femoreg_torch.statistics.formats import PAPER, Table, between, number, percent, plus_minus
from femoreg_torch.statistics.intervals import Correlation, mean_interval, spearman
from femoreg_torch.statistics.origins import SOURCES, relative_origins
from femoreg_torch.statistics.outcome import WRONG_DEG, WRONG_MM, told
from femoreg_torch.statistics.quantities import (
    AXES,
    BY_COLUMN,
    METRICS,
    OBJECTS,
    POSE_QUANTITIES,
    POSES,
    QUANTITIES,
    RELATIVE,
    Quantity,
)
from femoreg_torch.statistics.rows import (
    DONE,
    EVALUATIONS,
    FAILED,
    REFUSED,
    ROUND,
    ROUNDS,
    SECONDS,
    groups,
    plain_name,
    source,
    varied,
)
from femoreg_torch.statistics.summary import (
    Rate,
    Statistics,
    confusion,
    coverage,
    interval_of_mean,
    right_runs,
    statistics,
    trusted_runs,
    within,
)

_LIMITS_MM = (WRONG_MM, 2.0, 1.0)
_WRONG = f"wrong: off by more than {WRONG_MM:g} mm or {WRONG_DEG:g}°, or not found"


def group_tables(rows: pd.DataFrame, seed: int) -> list[Table]:
    """All tables of one group of runs; `seed` is that of the bootstrap."""
    tables = [
        pose_table(rows),
        metric_table(rows),
        error_table(rows, seed),
        success_table(rows),
        trust_table(rows),
        coverage_table(rows),
        round_table(rows, seed),
        dependence_table(rows),
        origin_table(rows, seed),
        cost_table(rows),
    ]
    return [table for table in tables if table.rows]


def pose_table(rows: pd.DataFrame) -> Table:
    """The paper's Table I: absolute errors of every pose along, and about, the axes of view 1."""
    lines, data = [], []
    for key, name in POSES.items():
        found = [(q, statistics(rows, q.column)) for unit in ("mm", "deg") for q in POSE_QUANTITIES[key][unit]]
        if not found[0][1].asked:
            continue
        lines += [
            (name, "mean ± SD", *(plus_minus(s.mean, s.deviation, q.digits) for q, s in found)),
            ("", "median", *(number(s.median, q.digits) for q, s in found)),
            ("", f"{PAPER}, mean ± SD", *(plus_minus(q.paper.mean, q.paper.deviation, 2) for q, _ in found)),
            ("", f"{PAPER}, median", *(number(q.paper.median, 2) for q, _ in found)),
        ]
        data += [_numbers(q, s) for q, s in found]
    axes = [axis.upper() for axis in AXES]
    columns = ("", "", *(f"{axis} mm" for axis in axes), "total mm", *(f"{axis} °" for axis in axes), "total °")
    return Table("poses", "Pose errors", _held(rows), columns, tuple(lines), pd.DataFrame(data))


def metric_table(rows: pd.DataFrame) -> Table:
    """The paper's Table II: entry point, guide tip, their relative error, and both directions."""
    found = [(q, s) for q in METRICS if (s := statistics(rows, q.column)).asked]
    lines = [
        (
            q.label,
            plus_minus(s.mean, s.deviation, q.digits),
            number(s.median, q.digits),
            plus_minus(q.paper.mean, q.paper.deviation, 2),
            number(q.paper.median, 2),
        )
        for q, s in found
    ]
    columns = ("", "mean ± SD", "median", "paper, mean ± SD", "paper, median")
    data = pd.DataFrame([_numbers(q, s) for q, s in found])
    return Table("metrics", "Errors that steer the drill", _held(rows), columns, tuple(lines), data)


def error_table(rows: pd.DataFrame, seed: int) -> Table:
    """Every error in total, with the interval of its mean, its tail, and how many runs each number holds."""
    trusted = rows[rows["trusted"]]
    lines, data = [], []
    for q in QUANTITIES:
        s = statistics(rows, q.column)
        if not s.asked:
            continue
        interval = interval_of_mean(rows, q.column, seed)
        of_trusted = float(told(trusted, q.column).median())
        lines.append(
            (
                q.label,
                f"{s.count} of {s.asked}",
                plus_minus(s.mean, s.deviation, q.digits),
                between(interval, q.digits),
                *(number(value, q.digits) for value in (s.median, of_trusted, s.percentile_95, s.maximum)),
                number(q.paper.mean, 2),
                number(q.paper.median, 2),
            )
        )
        data.append(_numbers(q, s) | dict(zip(("mean_low", "mean_high"), interval, strict=True)))
        data[-1]["median_trusted"] = of_trusted
    columns = (
        "", "runs in mean", "mean ± SD", "95 % of mean", "median", "median of trusted", "95th percentile", "maximum",
        "paper's mean", "paper's median",
    )  # fmt: skip
    note = _held(rows) + " 95 % of mean: bootstrap, bias-corrected and accelerated."
    return Table("errors", "Errors with intervals", note, columns, tuple(lines), pd.DataFrame(data))


def success_table(rows: pd.DataFrame) -> Table:
    """Shares of runs that are good enough; refused and failed runs are not."""
    rates = [(f"{RELATIVE.name} ≤ {limit:g} mm", within(rows, RELATIVE.column, limit)) for limit in _LIMITS_MM]
    rates += [
        (f"{BY_COLUMN[column].name} ≤ {WRONG_DEG:g}°", within(rows, column, WRONG_DEG))
        for column in ("path_deg", "guide_deg")
    ]
    rates += [
        (f"every pose within {WRONG_MM:g} mm and {WRONG_DEG:g}°, {RELATIVE.name} too", right_runs(rows)),
        ("trusted", trusted_runs(rows)),
    ]
    rates = [(name, rate) for name, rate in rates if rate.of]
    lines = tuple((name, f"{rate.met} of {rate.of}", *_rate(rate)) for name, rate in rates)
    data = pd.DataFrame([{"criterion": name, **_rate_numbers(rate)} for name, rate in rates])
    note = "Refused and failed runs count as not met. 95 %: Wilson's interval."
    return Table("success", "Success", note, ("", "runs", "rate", "95 %"), lines, data)


def trust_table(rows: pd.DataFrame) -> Table:
    """Right and wrong results against whether they say that they can be trusted."""
    lines, data = [], []
    for name in (None, *OBJECTS):
        if (found := confusion(rows, name)) is None:
            continue
        counts = (found.right_trusted, found.right_flagged, found.wrong_trusted, found.wrong_flagged)
        if not sum(counts):
            continue
        lines.append(("whole run" if name is None else name, *map(str, counts), *_rate(found.harm)))
        data.append({"object": name or "run", **vars(found), **_rate_numbers(found.harm)})
    columns = (
        "", "right, trusted", "right, flagged", "wrong, trusted", "wrong, flagged", "wrong of trusted", "95 %"
    )  # fmt: skip
    note = f"{_WRONG[0].upper()}{_WRONG[1:]}; a whole run also if {RELATIVE.name} is off by more than {WRONG_MM:g} mm."
    return Table("trust", "Trust", note, columns, tuple(lines), pd.DataFrame(data))


def coverage_table(rows: pd.DataFrame) -> Table:
    """Shares of errors within the standard deviations that the runs state."""
    lines, data = [], []
    for found in coverage(rows):
        unit = "mm" if found.unit == "mm" else "°"
        counts = sorted({rate.of for rate in (*found.within_1, *found.within_2)})
        lines.append(
            (
                f"{found.object}, {unit}",
                " to ".join(map(str, counts)),
                *(percent(rate.share) for rate in (*found.within_1, *found.within_2)),
            )
        )
        for times, rates in ((1, found.within_1), (2, found.within_2)):
            data += [
                {"object": found.object, "unit": found.unit, "axis": axis, "deviations": times, **_rate_numbers(rate)}
                for axis, rate in zip(AXES, rates, strict=True)
            ]
    columns = ("", "runs", *(f"{axis.upper()} within {times} σ" for times in (1, 2) for axis in AXES))
    note = "A deviation that is right covers 68.3 % within 1 σ and 95.4 % within 2 σ of a normal error."
    return Table("coverage", "Coverage of stated deviations", note, columns, tuple(lines), pd.DataFrame(data))


def round_table(rows: pd.DataFrame, seed: int) -> Table:
    """Of a closed loop: how far the guide is from the planned path, as imaged in each round and after it."""
    lines, data = [], []
    rounds = rows.groupby(ROUND) if ROUND in rows else ()
    for number_, part in rounds:
        found = {column: part[column].dropna() for column in ROUNDS if column in part}
        cells = []
        for column, values in found.items():
            digits = 2 if column.endswith("_mm") else 3
            interval = mean_interval(values, seed)
            mean, deviation = float(values.mean()), float(values.std(ddof=1))
            cells += [plus_minus(mean, deviation, digits), number(float(values.median()), digits)]
            data.append({"round": number_, "column": column, "runs": len(values), "mean": mean, "deviation": deviation})
            data[-1] |= {"mean_low": interval[0], "mean_high": interval[1], "median": float(values.median())}
        lines.append((str(int(number_)), str(len(part)), *cells))
    heads = [("before mm", "before_mm"), ("before °", "before_deg"), ("after mm", "left_mm"), ("after °", "left_deg")]
    columns = [f"{head}, {what}" for head, column in heads if column in rows for what in ("mean ± SD", "median")]
    note = (
        "True distance of the guide's tip from the entry point, and angle of the guide to the path. A result that is "
        "refused or not trusted moves nothing, and is the last one of its procedure."
    )
    return Table("rounds", "Closed loop", note, ("round", "runs", *columns), tuple(lines), pd.DataFrame(data))


_DEPENDENT = tuple(BY_COLUMN[column] for column in ("pelvis_mm", "femur_mm", "device_mm", "relative_mm"))


def dependence_table(rows: pd.DataFrame) -> Table:
    """Rank correlations of errors with every number that was varied."""
    quantities = [q for q in _DEPENDENT if told(rows, q.column).notna().any()]
    lines, data = [], []
    for key, part in varied(rows).items():
        if not pd.api.types.is_numeric_dtype(part[key]):
            continue
        found = [spearman(part[key].astype(float), told(part, q.column)) for q in quantities]
        if all(math.isnan(c.value) for c in found):
            continue
        lines.append((plain_name(key), *map(_correlation, found)))
        data += [{"varied": key, "error": q.column, **_correlated(c)} for q, c in zip(quantities, found, strict=True)]
    note = "Spearman's ρ with its 95 % interval, over the runs that gave an error. An interval around 0 tells nothing."
    columns = ("varied", *(q.name for q in quantities))
    return Table("dependence", "What errors depend on", note, columns, tuple(lines), pd.DataFrame(data))


def origin_table(rows: pd.DataFrame, seed: int) -> Table:
    """What C-arm views, femur and device explain of the relative error."""
    lines, data = [], []
    for found in relative_origins(rows, seed):
        ranges = [between((100 * o.interval[0], 100 * o.interval[1]), 0) for o in found.origins]
        shares = [f"{percent(o.share)} ({range_})" for o, range_ in zip(found.origins, ranges, strict=True)]
        partials = [percent(o.partial) for o in found.origins]
        lines.append((found.response, str(found.count), percent(found.r2), percent(found.adjusted), *shares, *partials))
        data += [
            {"response": found.response, "runs": found.count, "r2": found.r2, "adjusted_r2": found.adjusted}
            | {"group": o.group, "share": o.share, "low": o.interval[0], "high": o.interval[1], "partial": o.partial}
            for o in found.origins
        ]
    columns = ("", "runs", "R²", "adjusted", *SOURCES, *(f"{group}, partial R²" for group in SOURCES))
    note = (
        "Linear regression on the errors of each. R² is divided by the mean over all orders of entry, with 95 % "
        "bootstrap intervals; partial R² is what a group explains of that which the others leave. Length: by "
        "lengths and angles; along an axis: by signed parts."
    )
    title = f"Where the error from {RELATIVE.name} comes from"
    return Table("origins", title, note, columns, tuple(lines), pd.DataFrame(data))


def cost_table(rows: pd.DataFrame) -> Table:
    """Seconds and evaluations of a run, by what they were spent on; the longest first."""
    lines, data = [], []
    columns = [column for column in rows if column.startswith(SECONDS) and rows[column].notna().any()]
    medians = {column: float(rows[column].median()) for column in columns}
    for column in sorted(columns, key=lambda column: -medians[column]):
        name = column.removeprefix(SECONDS)
        seconds = rows[column].dropna()
        evaluations = EVALUATIONS + name
        mean = float(rows[evaluations].mean()) if evaluations in rows else float("nan")
        high = float(seconds.quantile(0.9))
        lines.append(
            (name.replace("_", " "), str(len(seconds)), number(medians[column], 2), number(high, 2), number(mean, 0))
        )
        data.append({"what": name, "runs": len(seconds), "median_s": medians[column], "percentile_90_s": high})
        data[-1]["evaluations"] = mean
    note = "Over the runs that tell them; they depend on what else the machines did."
    names = ("", "runs", "s, median", "s, 90th percentile", "evaluations, mean")
    return Table("costs", "Time of a run", note, names, tuple(lines), pd.DataFrame(data))


def overview_table(rows: pd.DataFrame) -> Table:
    """A row for every condition, and one for all."""
    lines, data = [], []
    for name, part in groups(rows).items():
        counts = {status: int(part["status"].eq(status).sum()) for status in (DONE, REFUSED, FAILED)}
        s, trusted, right = (
            statistics(part, RELATIVE.column),
            trusted_runs(part),
            within(part, RELATIVE.column, WRONG_MM),
        )
        whole = confusion(part)
        assert whole is not None  # of whole runs there always is one
        lines.append(
            (
                name,
                str(len(part)),
                *(str(counts[status]) for status in (REFUSED, FAILED)),
                percent(trusted.share),
                str(whole.wrong_trusted),
                plus_minus(s.mean, s.deviation, 2),
                number(s.median, 2),
                percent(right.share),
            )
        )
        data.append(
            {
                "condition": name,
                "runs": len(part),
                **counts,
                "trusted": trusted.met,
                "wrong_trusted": whole.wrong_trusted,
            }
            | {key: value for key, value in _numbers(RELATIVE, s).items() if not key.startswith(PAPER)}
            | {"success": right.met}
        )
    columns = (
        "condition", "runs", "refused", "failed", "trusted", "wrong, trusted", "mean ± SD, mm", "median, mm",
        f"≤ {WRONG_MM:g} mm",
    )  # fmt: skip
    return Table(
        "overview", f"The study, error {RELATIVE.name}", _failures(), columns, tuple(lines), pd.DataFrame(data)
    )


def _numbers(quantity: Quantity, found: Statistics) -> dict[str, Any]:
    """The row of a CSV."""
    paper = {f"{PAPER}_{key}": value for key, value in vars(quantity.paper).items()}
    return {"error": quantity.column, "unit": quantity.unit, **vars(found), **paper}


def _rate(rate: Rate) -> tuple[str, str]:
    low, high = rate.interval
    return percent(rate.share), between((100 * low, 100 * high), 1)


def _rate_numbers(rate: Rate) -> dict[str, float]:
    low, high = rate.interval
    return {"met": rate.met, "of": rate.of, "rate": rate.share, "low": low, "high": high}


def _correlation(found: Correlation) -> str:
    return f"{number(found.value, 2)} ({between(found.interval, 2)})"


def _correlated(found: Correlation) -> dict[str, float]:
    return {"rho": found.value, "low": found.interval[0], "high": found.interval[1], "runs": found.count}


def _failures() -> str:
    return "Medians, percentiles and rates count refused and failed runs as infinitely far off; means cannot hold them."


def _held(rows: pd.DataFrame) -> str:
    """What became of the runs of a table, in a sentence."""
    counts = {status: int(rows["status"].eq(status).sum()) for status in (DONE, REFUSED, FAILED)}
    flagged = counts[DONE] - int(rows["trusted"].sum())
    told_counts = ", ".join(f"{count} {status}" for status, count in counts.items())
    runs = f"{len(rows)} {source(rows)} runs: {told_counts}; of the done ones {flagged} are flagged, and counted here."
    return f"{runs} {_failures()}"
