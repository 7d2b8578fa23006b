"""The errors that a study tells: their columns, their units, and the paper's values beside them.

The paper is Gao et al., IEEE Trans Med Robot Bionics 2 (2020) 437: Tables I, II and III, Figure 9.
"""

import math
from dataclasses import dataclass

from femoreg_torch.configs import load_preset

AXES = ("is", "lr", "ap")  # ends of the names of signed columns: along, or about, IS, LR and AP of view 1
POSES = {  # key of the columns: what to call it
    "pelvis": "pelvis",
    "femur": "femur",
    "device": "device",
    "view2": "C-arm view 2",
    "view3": "C-arm view 3",
}
OBJECTS = ("pelvis", "femur", "device")  # those of POSES that a run states a deviation and a verdict of
PELVIS_AT_HEAD = "pelvis_at_head_mm"  # optional: displacement of the pelvis at the femoral head, as in Figure 9

_PAPER = load_preset("paper", "gao2020")
_CADAVER = load_preset("paper", "gao2020_cadaver")
PAPER_TRIALS: dict[str, list[float]] = _CADAVER["metrics"]  # Table III: column to the values of its trials
PAPER_TRIAL_NAMES: list[str] = _CADAVER["trials"]
PAPER_CORRELATIONS: dict[str, float] = _PAPER["correlations"]  # of `pelvis_at_head_mm` with these columns


@dataclass(frozen=True)
class Paper:
    """What the paper says of one quantity over its 1,000 simulations."""

    mean: float
    deviation: float
    median: float


@dataclass(frozen=True)
class Quantity:
    """One error of a run: its column, what to call it, and the paper's value of it."""

    column: str
    name: str
    unit: str  # mm or °
    paper: Paper  # not a number where the paper tells nothing of it

    @property
    def digits(self) -> int:
        """Decimals that a table tells."""
        return 2 if self.unit == "mm" else 3

    @property
    def label(self) -> str:
        """Name and unit, for the axis of a plot."""
        return f"{self.name}, {self.unit}"


def _of_pose(key: str, unit: str) -> tuple[Quantity, ...]:
    """Along, or about, IS, LR and AP, then the total."""
    row, sign = _PAPER["poses"][key], {"mm": "mm", "deg": "°"}[unit]
    kind = "" if unit == "mm" else " rotation"
    names = [f"{POSES[key]}{kind} {axis.upper()}" for axis in AXES] + [f"{POSES[key]}{kind}"]
    columns = [f"{key}_{unit}_{axis}" for axis in AXES] + [f"{key}_{unit}"]
    papers = zip(row[unit], row[f"{unit}_sd"], row[f"{unit}_median"], strict=True)
    return tuple(Quantity(c, n, sign, Paper(*p)) for c, n, p in zip(columns, names, papers, strict=True))


def _metric(column: str, name: str) -> Quantity:
    values = (_PAPER[key][column] for key in ("metrics", "metrics_sd", "metrics_median"))
    return Quantity(column, name, "mm" if column.endswith("_mm") else "°", Paper(*values))


# Table I: of every pose, in mm and in degrees, three axes and the total.
POSE_QUANTITIES = {key: {unit: _of_pose(key, unit) for unit in ("mm", "deg")} for key in POSES}
# Table II.
METRICS = (
    _metric("entry_point_mm", "entry point"),
    _metric("tip_mm", "guide tip"),
    _metric("relative_mm", "entry point to tip"),
    _metric("path_deg", "femur path"),
    _metric("guide_deg", "guide path"),
)
QUANTITIES = (*(rows[unit][-1] for rows in POSE_QUANTITIES.values() for unit in ("mm", "deg")), *METRICS)
BY_COLUMN = {quantity.column: quantity for quantity in QUANTITIES}
RELATIVE = BY_COLUMN["relative_mm"]
# Of the tool against its planned place, once an exact robot has moved it as the run tells; see `evaluation.path_miss`.
_UNTOLD = Paper(math.nan, math.nan, math.nan)
MISSES = (
    Quantity("miss_mm", "entry point after an exact correction", "mm", _UNTOLD),
    Quantity("miss_deg", "turn after an exact correction", "°", _UNTOLD),
)
