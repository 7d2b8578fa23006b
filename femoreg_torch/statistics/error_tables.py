"""Errors of a group of runs: the paper's Tables I and II beside its values, and each error with its interval."""

import pandas as pd

from femoreg_torch.statistics.cells import about_runs, error_numbers
from femoreg_torch.statistics.formats import PAPER, Table, between, number, plus_minus
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import AXES, METRICS, MISSES, POSE_QUANTITIES, POSES, QUANTITIES
from femoreg_torch.statistics.summary import Statistics, interval_of_mean, statistics


def pose_table(rows: pd.DataFrame) -> Table:
    """The paper's Table I: absolute errors of every pose along, and about, the axes of view 1."""
    lines, data = [], []
    for key, name in POSES.items():
        found = [(q, statistics(rows, q.column)) for unit in ("mm", "deg") for q in POSE_QUANTITIES[key][unit]]
        if not found[0][1].asked:
            continue
        lines += [
            (name, "mean ± SD", _count(found[0][1]), *(plus_minus(s.mean, s.deviation, q.digits) for q, s in found)),
            ("", "median", "", *(number(s.median, q.digits) for q, s in found)),
            ("", f"{PAPER}, mean ± SD", "", *(plus_minus(q.paper.mean, q.paper.deviation, 2) for q, _ in found)),
            ("", f"{PAPER}, median", "", *(number(q.paper.median, 2) for q, _ in found)),
        ]
        data += [error_numbers(q, s) for q, s in found]
    axes = [axis.upper() for axis in AXES]
    columns = (
        "",
        "",
        "runs in mean",
        *(f"{axis} mm" for axis in axes),
        "total mm",
        *(f"{axis} °" for axis in axes),
        "total °",
    )
    return Table("poses", "Pose errors", about_runs(rows), columns, tuple(lines), pd.DataFrame(data))


def metric_table(rows: pd.DataFrame) -> Table:
    """The paper's Table II: entry point, guide tip, their relative error, and both directions."""
    found = [(q, s) for q in METRICS if (s := statistics(rows, q.column)).asked]
    lines = [
        (
            q.label,
            _count(s),
            plus_minus(s.mean, s.deviation, q.digits),
            number(s.median, q.digits),
            plus_minus(q.paper.mean, q.paper.deviation, 2),
            number(q.paper.median, 2),
        )
        for q, s in found
    ]
    columns = ("", "runs in mean", "mean ± SD", "median", "paper, mean ± SD", "paper, median")
    data = pd.DataFrame([error_numbers(q, s) for q, s in found])
    return Table("metrics", "Errors that steer the drill", about_runs(rows), columns, tuple(lines), data)


def error_table(rows: pd.DataFrame, seed: int) -> Table:
    """Every error in total, with the interval of its mean, its tail, and how many runs each number holds.

    What a correction leaves stands below where the runs tell it; runs of older versions do not.
    """
    trusted = rows[rows["trusted"]]
    lines, data = [], []
    for q in (*QUANTITIES, *(q for q in MISSES if q.column in rows)):
        s = statistics(rows, q.column)
        if not s.asked:
            continue
        interval = interval_of_mean(rows, q.column, seed)
        of_trusted = float(told(trusted, q.column).median())
        lines.append(
            (
                q.label,
                _count(s),
                plus_minus(s.mean, s.deviation, q.digits),
                between(interval, q.digits),
                *(number(value, q.digits) for value in (s.median, of_trusted, s.percentile_95, s.maximum)),
                number(q.paper.mean, 2),
                number(q.paper.median, 2),
            )
        )
        data.append(error_numbers(q, s) | dict(zip(("mean_low", "mean_high"), interval, strict=True)))
        data[-1]["median_trusted"] = of_trusted
    columns = (
        "", "runs in mean", "mean ± SD", "95 % of mean", "median", "median of trusted", "95th percentile", "maximum",
        "paper's mean", "paper's median",
    )  # fmt: skip
    note = about_runs(rows) + " 95 % of mean: bootstrap, bias-corrected and accelerated."
    return Table("errors", "Errors with intervals", note, columns, tuple(lines), pd.DataFrame(data))


def _count(found: Statistics) -> str:
    return f"{found.count} of {found.asked}"
