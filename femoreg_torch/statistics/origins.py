"""Which error the relative error comes from: linear regression, its R² divided among C-arm views, femur and device.

R² is divided by the mean over all orders in which the groups can enter (Lindeman, Merenda & Gold 1980; Grömping, Am
Stat 61 (2007) 139), so that the shares of correlated groups sum to R². The partial R² of a group is what it explains of
that which the other groups leave. Shares have no intervals: R² of resampled runs lies above the true one, so that the
bootstrap's do not hold.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import comb

import numpy as np
import pandas as pd

from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import AXES
from femoreg_torch.statistics.rows import DONE

SOURCES = {"C-arm views": ("view2", "view3"), "femur": ("femur",), "device": ("device",)}
_SAME = 1e-10  # below this share of the largest eigenvalue columns tell the same
_RUNS_PER_COLUMN = 3  # fewer let a regression explain noise


@dataclass(frozen=True)
class Origin:
    """One group of errors, and what it explains of the response."""

    group: str
    share: float  # of the response's variance; those of all groups sum to R²
    partial: float  # partial R²


@dataclass(frozen=True)
class Explanation:
    """What all groups together explain of one response."""

    response: str
    count: int  # runs
    r2: float
    adjusted: float  # R² adjusted for the number of columns
    origins: tuple[Origin, ...]


def explained(response: np.ndarray, groups: Mapping[str, np.ndarray], name: str) -> Explanation:
    """Regress `response` (N,) on the columns (N, k) of all groups."""
    sizes = [part.shape[1] for part in groups.values()]
    values = np.column_stack([*groups.values(), response])
    shares, partials, r2 = _division(values, sizes)
    adjusted = 1 - (1 - r2) * (len(values) - 1) / (len(values) - sum(sizes) - 1)
    return Explanation(
        name,
        len(response),
        r2,
        adjusted,
        tuple(Origin(group, float(shares[k]), float(partials[k])) for k, group in enumerate(groups)),
    )


def _division(values: np.ndarray, sizes: list[int]) -> tuple[np.ndarray, np.ndarray, float]:
    """Share and partial R² of every group, and R² of all; `values` (N, k) are the groups' columns, then the response.

    R² of some columns follows from correlations alone: r' C⁻¹ r, of the columns with one another and with the response.
    """
    count, ends = len(sizes), np.cumsum([0, *sizes])
    spread = values.std(0)
    correlations = np.cov((values / np.where(spread > 0, spread, 1)).T, ddof=0)  # 0 with a column that does not vary
    columns = [list(range(start, end)) for start, end in pairwise(ends)]
    r2 = {
        subset: _r2(correlations, [column for k in subset for column in columns[k]])
        for size in range(count + 1)
        for subset in combinations(range(count), size)
    }
    whole = tuple(range(count))
    shares, partials = np.zeros(count), np.zeros(count)
    for k in whole:
        others = tuple(other for other in whole if other != k)
        for size in range(count):
            gains = [r2[tuple(sorted((*s, k)))] - r2[s] for s in combinations(others, size)]
            shares[k] += sum(gains) / (count * comb(count - 1, size))
        left = 1 - r2[others]
        partials[k] = (r2[whole] - r2[others]) / left if left > 1e-12 else float("nan")
    return shares, partials, r2[whole]


def _r2(correlations: np.ndarray, columns: list[int]) -> float:
    if not columns:
        return 0.0
    with_response = correlations[columns, -1]
    inner = correlations[np.ix_(columns, columns)]
    return float(with_response @ np.linalg.lstsq(inner, with_response, rcond=_SAME)[0])


def relative_origins(rows: pd.DataFrame) -> list[Explanation]:
    """Of the length of the relative error by lengths and angles, and of each of its parts by signed ones.

    The parts need the optional columns `entry_point_mm_is`, `tip_mm_is`, …. What too few runs could tell is left out.
    """
    done = rows[rows["status"].eq(DONE)]
    totals = {group: [f"{key}_{unit}" for key in keys for unit in ("mm", "deg")] for group, keys in SOURCES.items()}
    signed = {group: [f"{column}_{axis}" for column in columns for axis in AXES] for group, columns in totals.items()}
    found = [_explanation(done, told(done, "relative_mm"), totals, "length")]
    for axis in AXES:
        points = [f"{point}_mm_{axis}" for point in ("entry_point", "tip")]
        if all(point in done for point in points):
            response = done[points[0]] - done[points[1]]
            found.append(_explanation(done, response, signed, f"along {axis.upper()}"))
    return [explanation for explanation in found if explanation is not None]


def _explanation(
    rows: pd.DataFrame, response: pd.Series, columns: Mapping[str, list[str]], name: str
) -> Explanation | None:
    every = [column for group in columns.values() for column in group]
    if any(column not in rows for column in every):
        return None
    whole = rows[every].notna().all(axis=1) & response.notna()
    values = response[whole].to_numpy(float)
    if len(values) < _RUNS_PER_COLUMN * len(every) or np.ptp(values) == 0:
        return None
    return explained(values, {g: rows.loc[whole, c].to_numpy(float) for g, c in columns.items()}, name)
