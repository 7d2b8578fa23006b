"""Cells and notes that several tables share."""

from typing import Any

import pandas as pd

from femoreg_torch.statistics.formats import PAPER, between, percent
from femoreg_torch.statistics.quantities import Quantity
from femoreg_torch.statistics.rows import DONE, FAILED, REFUSED, procedures, source
from femoreg_torch.statistics.summary import Rate, Statistics


def error_numbers(quantity: Quantity, found: Statistics) -> dict[str, Any]:
    """An error, its statistics and the paper's values in the row of a CSV."""
    paper = {f"{PAPER}_{key}": value for key, value in vars(quantity.paper).items()}
    return {"error": quantity.column, "unit": quantity.unit, **vars(found), **paper}


def rate_cells(rate: Rate) -> tuple[str, str]:
    """A rate and its interval, in percent."""
    low, high = rate.interval
    return percent(rate.share), between((100 * low, 100 * high), 1)


def rate_numbers(rate: Rate) -> dict[str, float]:
    """A rate in the row of a CSV."""
    low, high = rate.interval
    return {"met": rate.met, "of": rate.of, "rate": rate.share, "low": low, "high": high}


def about_failures() -> str:
    """How runs count that gave no error."""
    return "Medians, percentiles and rates count refused and failed runs as infinitely far off; means cannot hold them."


def about_runs(rows: pd.DataFrame) -> str:
    """What became of the runs of a table, in a sentence."""
    counts = {status: int(rows["status"].eq(status).sum()) for status in (DONE, REFUSED, FAILED)}
    flagged = counts[DONE] - int(rows["trusted"].sum())
    told_counts = ", ".join(f"{count} {status}" for status, count in counts.items())
    apart = procedures(rows).nunique()
    of = "" if apart == len(rows) else f" of {apart} procedures"
    runs = (
        f"{len(rows)} {source(rows)} runs{of}: {told_counts}; of the done ones {flagged} are flagged, and counted here."
    )
    return f"{runs} {about_failures()}"
