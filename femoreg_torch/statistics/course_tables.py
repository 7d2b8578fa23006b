"""How runs went: the rounds of a closed loop, and what time was spent on."""

import pandas as pd

from femoreg_torch.statistics.formats import Table, number, plus_minus
from femoreg_torch.statistics.intervals import mean_interval
from femoreg_torch.statistics.rows import EVALUATIONS, ROUND, ROUNDS, SECONDS, procedures


def round_table(rows: pd.DataFrame, seed: int) -> Table:
    """Of a closed loop: how far the guide is from the planned path, as imaged in each round and after it."""
    lines, data = [], []
    rounds = rows.groupby(ROUND) if ROUND in rows else ()
    for number_, part in rounds:
        found = {column: part[column].dropna() for column in ROUNDS if column in part}
        cells = []
        for column, values in found.items():
            digits = 2 if column.endswith("_mm") else 3
            interval = mean_interval(values, seed, procedures(part)[values.index])
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
