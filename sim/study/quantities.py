"""The errors that a study tells, the paper's means beside them, and what is wanted of this project."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from femoreg_torch.evaluation import PAPER_METRICS, PAPER_POSES


@dataclass(frozen=True)
class Quantity:
    """One error: where it stands in `femoreg_torch.evaluation.errors`, and means to hold against it."""

    name: str
    path: tuple[str, ...]
    unit: str
    paper: float  # mean of the paper's 1,000 simulations
    wanted: float  # mean that the `fast` preset may have at most
    aim: float

    def of(self, errors: dict[str, Any]) -> float:
        """Its value among the errors of one run; nan where the run has none."""
        value: Any = errors
        for key in self.path:
            value = value.get(key, {})
        return float("nan") if isinstance(value, dict) else float(value)


def _pose(key: str, name: str, wanted: tuple[float, float], aim: tuple[float, float]) -> list[Quantity]:
    millimetres, degrees = (row[-1] for row in PAPER_POSES[key])
    return [
        Quantity(name, (key, "mm"), "mm", millimetres, wanted[0], aim[0]),
        Quantity(f"{name}, rotation", (key, "deg"), "°", degrees, wanted[1], aim[1]),
    ]


def _metric(key: str, name: str, unit: str, wanted: float, aim: float) -> Quantity:
    return Quantity(name, (key,), unit, PAPER_METRICS[key], wanted, aim)


QUANTITIES: Sequence[Quantity] = (
    *_pose("pelvis", "pelvis", (0.45, 0.10), (0.15, 0.04)),
    *_pose("femur", "femur", (0.40, 0.30), (0.20, 0.10)),
    *_pose("device", "device", (0.50, 0.12), (0.20, 0.06)),
    *_pose("view2", "C-arm view 2", (0.65, 0.12), (0.25, 0.05)),
    *_pose("view3", "C-arm view 3", (0.35, 0.08), (0.20, 0.05)),
    _metric("entry_point_mm", "entry point", "mm", 0.80, 0.30),
    _metric("tip_mm", "guide tip", "mm", 0.45, 0.20),
    _metric("relative_mm", "entry point to tip", "mm", 0.60, 0.35),
    _metric("path_deg", "femur path", "°", 0.30, 0.10),
    _metric("guide_deg", "guide path", "°", 0.09, 0.05),
)
