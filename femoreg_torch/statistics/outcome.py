"""What became of each run: whether it should have an error, how large it is, and whether it is wrong.

Nothing is forgotten: a run that was refused, that failed, or that does not place an object which it should, counts as
infinitely far off. An object should be placed by the runs of a condition if its images show it (column `asked`, where a
study tells it) or any of its runs places it, and where none gives a result at all; images without the device ask for no
device.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from femoreg_torch.statistics.quantities import OBJECTS
from femoreg_torch.statistics.rows import ASKED, DONE

WRONG_MM, WRONG_DEG = 4.0, 2.0
"""Beyond these a pose that says it can be trusted does harm. 4 mm: the deviation whose effect the paper computed."""


def told(rows: pd.DataFrame, column: str) -> pd.Series:
    """Absolute errors of the runs that are done; nan elsewhere, and everywhere if there is no such column."""
    if column not in rows:
        return pd.Series(np.nan, rows.index)
    return rows[column].abs().where(rows["status"].eq(DONE))


def asked(rows: pd.DataFrame, column: str) -> pd.Series:
    """Of every run: whether it should have this error."""
    done, conditions = rows["status"].eq(DONE), rows["condition"]
    there = told(rows, column).notna()
    if ASKED in rows and (name := column.rpartition("_")[0]) in OBJECTS:
        there |= rows[ASKED].str.split().map(lambda objects: name in objects)
    return there.groupby(conditions).transform("any") | ~done.groupby(conditions).transform("any")


def everything(rows: pd.DataFrame, column: str) -> np.ndarray:
    """Absolute errors (N,) of all runs that should have one; infinite where a run gave none."""
    return told(rows, column).fillna(np.inf)[asked(rows, column)].to_numpy(float)


def object_is_wrong(rows: pd.DataFrame, name: str) -> pd.Series:
    """Of every run: whether an object is off by more than 4 mm or 2°, or is not placed though it should be.

    Where runs tell only one of the two, the other was not measured, and is not asked.
    """
    limits = {f"{name}_mm": WRONG_MM, f"{name}_deg": WRONG_DEG}
    measured = [column for column in limits if told(rows, column).notna().any()]
    wrong = pd.Series(False, rows.index)
    for column in measured or limits:
        wrong |= asked(rows, column) & ~(told(rows, column) <= limits[column])
    return wrong


def run_is_wrong(rows: pd.DataFrame, objects: Sequence[str] = OBJECTS) -> pd.Series:
    """Of every run: whether any object is wrong, or entry point against guide tip is off by more than 4 mm."""
    wrong = asked(rows, "relative_mm") & ~(told(rows, "relative_mm") <= WRONG_MM)
    for name in objects:
        wrong |= object_is_wrong(rows, name)
    return wrong


def is_flagged(rows: pd.DataFrame, name: str | None = None) -> pd.Series:
    """Of every run: whether it, or its object, says that it cannot be trusted. What gave no pose is flagged."""
    column = "trusted" if name is None else f"{name}_trusted"
    return ~(rows[column] & rows["status"].eq(DONE))
