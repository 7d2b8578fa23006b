"""The paper's Table III: trials on a specimen, one by one, errors against beads.

The paper gives its errors as they are. Where trials tell what the beads themselves leave open of each, it stands below.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from femoreg_torch.statistics.formats import PAPER, Table, number, plus_minus
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import METRICS, PAPER_TRIAL_NAMES, PAPER_TRIALS
from femoreg_torch.statistics.rows import BEADS, DONE

if TYPE_CHECKING:
    from femoreg_torch.beads import Trial  # loads torch, which reading a table does not need


def rows_of_trials(trials: "Sequence[Trial]", study: str) -> pd.DataFrame:
    """A row per trial, as a study has one per run; its condition is the trial's name."""
    return pd.DataFrame(
        [
            {
                "study": study,
                "condition": trial.name,
                "number": number_,
                "patient": "",
                "kind": "trial",
                "side": trial.side or "",
                "seed": trial.result.seed,
                "preset": trial.result.preset,
                "code": trial.result.versions.get("femoreg_torch", ""),
                "settings": "",
                "status": DONE,
                "reason": "",
                "trusted": trial.result.verdict.trusted,
                "reasons": "; ".join(trial.result.verdict.reasons),
            }
            | trial.errors
            | {BEADS + key: value for key, value in trial.truth.items()}
            for number_, trial in enumerate(trials, 1)
        ]
    )


def trial_table(rows: pd.DataFrame) -> Table:
    """A column for every trial, named by its condition; below each row what the beads leave open, and the paper's.

    A star marks a trial whose registration does not trust itself.
    """
    lines, data = [], []
    trials = [str(name) for name in rows["condition"]]
    columns = max(len(trials), len(PAPER_TRIAL_NAMES))
    for quantity in METRICS:
        values = told(rows, quantity.column).to_numpy(float)
        beads = told(rows, BEADS + quantity.column).to_numpy(float)
        paper = np.array(PAPER_TRIALS[quantity.column])
        if np.isnan(values).all():
            continue
        digits = quantity.digits
        lines.append((quantity.label, _mean(values, digits), *_cells(values, digits, columns)))
        if not np.isnan(beads).all():
            rms = float(np.sqrt(np.nanmean(beads**2)))
            lines.append(("beads alone", f"{number(rms, digits)} rms", *_cells(beads, digits, columns)))
        first, last = PAPER_TRIAL_NAMES[0], PAPER_TRIAL_NAMES[-1]
        lines.append((f"{PAPER} ({first} to {last})", _mean(paper, 2), *_cells(paper, 2, columns)))
        data += [
            {"error": quantity.column, "unit": quantity.unit, "trial": trial, "value": value, "beads_alone": own}
            for trial, value, own in zip(trials, values, beads, strict=True)
        ]
    stars = [" *" if doubtful else "" for doubtful in rows["status"].eq(DONE) & ~rows["trusted"]]
    head = [name + star for name, star in zip(trials, stars, strict=True)] + [""] * (columns - len(trials))
    note = (
        f"{len(trials)} trial{'s' * (len(trials) != 1)}; – where one gave no error, which mean and deviation then do "
        "not hold. Beads alone: root mean square of what the beads leave open. *: the registration does not trust "
        "itself. The paper's six trials were made on another specimen."
    )
    return Table("trials", "Trials", note, ("", "mean ± SD", *head), tuple(lines), pd.DataFrame(data))


def _mean(values: np.ndarray, digits: int) -> str:
    given = values[~np.isnan(values)]
    return plus_minus(float(given.mean()), float(given.std(ddof=1)) if len(given) > 1 else float("nan"), digits)


def _cells(values: np.ndarray, digits: int, columns: int) -> list[str]:
    return [number(float(value), digits) for value in values] + [""] * (columns - len(values))
