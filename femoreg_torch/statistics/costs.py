"""What the steps of a registration cost."""

import re
from dataclasses import dataclass

import pandas as pd

from femoreg_torch.statistics.rows import EVALUATIONS, SECONDS

_OF_VIEW = re.compile(r"_view\d+$")  # how names of steps end that are run on each view by itself


@dataclass(frozen=True)
class StageCost:
    """What one step costs, per run: sums over the views that it is run on."""

    name: str
    evaluations: float  # mean
    seconds: float  # median


def stage_costs(rows: pd.DataFrame) -> list[StageCost]:
    """Of every step, in the order of the columns, over the runs that tell it."""
    steps: dict[str, list[str]] = {}
    for column in rows:
        if column.startswith(EVALUATIONS) and rows[column].notna().any():
            name = column.removeprefix(EVALUATIONS)
            steps.setdefault(_OF_VIEW.sub("", name), []).append(name)
    found = []
    for step, parts in steps.items():
        evaluations, seconds = (
            rows[[f"{start}{part}" for part in parts]].sum(axis=1, min_count=1) for start in (EVALUATIONS, SECONDS)
        )
        found.append(StageCost(step.replace("_", " "), float(evaluations.mean()), float(seconds.median())))
    return found
