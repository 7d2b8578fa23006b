"""Two studies side by side: differences of mean errors and of success, by procedures where both hold the same ones."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from femoreg_torch.statistics.formats import Table, between, number, percent
from femoreg_torch.statistics.intervals import UNKNOWN, Interval, difference_interval, mean_interval
from femoreg_torch.statistics.outcome import WRONG_MM, asked, told
from femoreg_torch.statistics.quantities import QUANTITIES, RELATIVE
from femoreg_torch.statistics.rows import ALL, PROCEDURE, ROUND, folder_name, groups, procedures


@dataclass(frozen=True)
class Difference:
    """Of two means, first less second, with its 95 % interval."""

    first: float
    second: float
    interval: Interval
    counts: tuple[int, int]  # runs that the means hold; the same ones if paired
    paired: bool

    @property
    def value(self) -> float:
        """First less second."""
        return self.first - self.second

    @property
    def clear(self) -> bool:
        """Whether the interval lies on one side of 0."""
        return self.interval[0] > 0 or self.interval[1] < 0


def matched(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame | None:
    """Positions in both of the runs of one procedure; None unless every procedure of the smaller is in the larger.

    The name of a condition tells procedures apart only where both studies have the same conditions: a study under
    another name may be one of the same procedures. A procedure that a study holds twice cannot be matched.
    """
    same = set(first["condition"]) == set(second["condition"])
    keys = ["condition"] * same + list(PROCEDURE) + [ROUND] * (ROUND in first and ROUND in second)
    if any(rows.duplicated(keys).any() for rows in (first, second)):
        return None
    found = [rows[keys].assign(**{name: range(len(rows))}) for name, rows in (("first", first), ("second", second))]
    pairs = found[0].merge(found[1], on=keys)
    return pairs[["first", "second"]] if len(pairs) == min(len(first), len(second)) else None


def difference(
    first: "pd.Series[float]",
    second: "pd.Series[float]",
    pairs: pd.DataFrame | None,
    clusters: tuple[np.ndarray, np.ndarray],
    seed: int,
) -> Difference:
    """Of the means of two series of values, nan where a run has none, by `pairs` of `matched` if there are any.

    `clusters` are numbers that the runs of one procedure share. Of unpaired runs some of which share one there is no
    interval.
    """
    a, b = first.to_numpy(float), second.to_numpy(float)
    if pairs is None:
        apart = all(len(np.unique(numbers)) == len(numbers) for numbers in clusters)
        a, b = a[~np.isnan(a)], b[~np.isnan(b)]
        interval = difference_interval(a, b, seed) if apart else UNKNOWN
    else:
        a, b = a[pairs["first"]], b[pairs["second"]]
        both = ~np.isnan(a) & ~np.isnan(b)
        a, b = a[both], b[both]
        interval = mean_interval(a - b, seed, clusters[0][pairs["first"]][both])
    means = [float(part.mean()) if len(part) else float("nan") for part in (a, b)]
    return Difference(means[0], means[1], interval, (len(a), len(b)), pairs is not None)


def beside_tables(first: pd.DataFrame, second: pd.DataFrame, names: tuple[str, str], seed: int) -> list[Table]:
    """A table for every condition that both studies have; for all runs, if they have the same conditions, or none."""
    there, here = groups(first), groups(second)
    common = [name for name in there if name in here and name != ALL]
    tables = [beside_table(there[name], here[name], names, name, seed) for name in common]
    if not common or len(common) == first["condition"].nunique() == second["condition"].nunique() > 1:
        tables.insert(0, beside_table(first, second, names, ALL, seed))
    return tables


def beside_table(first: pd.DataFrame, second: pd.DataFrame, names: tuple[str, str], group: str, seed: int) -> Table:
    """Mean errors of two groups of runs, both called `group`, and the share of runs that are good enough."""
    pairs = matched(first, second)
    clusters = procedures(first).to_numpy(), procedures(second).to_numpy()
    lines, data = [], []
    for quantity in QUANTITIES:
        found = difference(told(first, quantity.column), told(second, quantity.column), pairs, clusters, seed)
        if min(found.counts):
            means = [number(value, quantity.digits) for value in (found.first, found.second)]
            told_difference = number(found.value, quantity.digits, "+"), between(found.interval, quantity.digits)
            lines.append((quantity.label, _counts(found), *means, *told_difference, _clear(found)))
            data.append(_numbers(quantity.column, found))
    found = difference(_good(first), _good(second), pairs, clusters, seed)
    if min(found.counts):
        shares = [percent(value) for value in (found.first, found.second)]
        low, high = found.interval
        told_difference = f"{number(100 * found.value, 1, '+')} %", between((100 * low, 100 * high), 1)
        name_of_rate = f"{RELATIVE.name} ≤ {WRONG_MM:g} mm"
        lines.append((name_of_rate, _counts(found), *shares, *told_difference, _clear(found)))
        data.append(_numbers("success", found))
    how = "Paired: differences of the same procedures." if pairs is not None else "Not paired: different procedures."
    note = (
        f"{how} 95 %: bootstrap of the difference, runs of one procedure drawn together; of few, Student's or Welch's, "
        "and of shares that are not paired, Newcombe's. Clear if it does not hold 0, – where it is not known, as of "
        "unpaired studies with several runs of a procedure, or of differences that are all the same. "
        "Runs that gave no error are in no mean; in the share of good runs they count as not good."
    )
    columns = ("mean error", "runs", *names, "difference", "95 %", "clear")
    title = f"{names[0]} beside {names[1]}: {group}"
    return Table(f"beside_{folder_name(group)}", title, note, columns, tuple(lines), pd.DataFrame(data))


def _good(rows: pd.DataFrame) -> pd.Series:
    """1 where the relative error is small enough, 0 where it is not or is not known, nan where none is asked for."""
    good = (told(rows, RELATIVE.column) <= WRONG_MM).astype(float)
    return good.where(asked(rows, RELATIVE.column))


def _counts(found: Difference) -> str:
    a, b = found.counts
    return str(a) if found.paired else f"{a}, {b}"


def _clear(found: Difference) -> str:
    return "–" if np.isnan(found.interval[0]) and found.value != 0 else "yes" if found.clear else "no"


def _numbers(column: str, found: Difference) -> dict[str, object]:
    return {
        "error": column, "first": found.first, "second": found.second, "difference": found.value,
        "low": found.interval[0], "high": found.interval[1],
        "runs_first": found.counts[0], "runs_second": found.counts[1], "paired": found.paired,
    }  # fmt: skip
