"""The paper's Table III: trials on a specimen, one by one, errors against beads."""

import numpy as np
import pandas as pd

from femoreg_torch.statistics.formats import PAPER, Table, number, plus_minus
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import METRICS, PAPER_TRIAL_NAMES, PAPER_TRIALS


def trial_table(rows: pd.DataFrame) -> Table:
    """A column for every trial, named by its condition; below each row the paper's trials."""
    lines, data = [], []
    trials = [str(name) for name in rows["condition"]]
    columns = max(len(trials), len(PAPER_TRIAL_NAMES))
    for quantity in METRICS:
        values = told(rows, quantity.column).to_numpy(float)
        paper = np.array(PAPER_TRIALS[quantity.column])
        if np.isnan(values).all():
            continue
        lines += [
            (quantity.label, _mean(values, quantity.digits), *_cells(values, quantity.digits, columns)),
            (
                f"{PAPER} ({PAPER_TRIAL_NAMES[0]} to {PAPER_TRIAL_NAMES[-1]})",
                _mean(paper, 2),
                *_cells(paper, 2, columns),
            ),
        ]
        data += [
            {"error": quantity.column, "unit": quantity.unit, "trial": trial, "value": value}
            for trial, value in zip(trials, values, strict=True)
        ]
    head = (*trials, *[""] * (columns - len(trials)))
    note = (
        f"{len(trials)} trials; – where one gave no error, which mean and deviation then do not hold. The paper's six "
        "trials were made on another specimen."
    )
    return Table("trials", "Trials", note, ("", "mean ± SD", *head), tuple(lines), pd.DataFrame(data))


def _mean(values: np.ndarray, digits: int) -> str:
    given = values[~np.isnan(values)]
    return plus_minus(float(given.mean()), float(given.std(ddof=1)) if len(given) > 1 else float("nan"), digits)


def _cells(values: np.ndarray, digits: int, columns: int) -> list[str]:
    return [number(float(value), digits) for value in values] + [""] * (columns - len(values))
