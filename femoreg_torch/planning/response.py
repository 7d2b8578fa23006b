"""How the gain of a plan answers to small errors of its path: a quadratic through the loads of the moved plan.

The path is told by five numbers: where its entry point lies (mm, LPS), and how far its end lies, square to it, from
where a shift alone would put it. Along each of them the model was run at a distance to both sides; between two of them
nothing was run, so their products are left out. A registration then needs no finite elements to say what its
uncertainty costs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.planning.offsets import Outcome, end_axes

Array = NDArray[np.float64]

_PAIRS = (
    ("left", "right"),
    ("posterior", "anterior"),
    ("superior", "inferior"),
    ("end superior", "end inferior"),
    ("end anterior", "end posterior"),
)


@dataclass(frozen=True, eq=False)
class Response:
    """The gain in % of a path that is off by q (5,) mm: gain + slope · q + Σ curvature q² / 2."""

    gain_percent: float  # as planned
    slope: Array  # (5,) % per mm
    curvature: Array  # (5,) % per mm²
    distance_mm: float  # to which it was computed
    entry: Array  # (3,) LPS mm
    target: Array  # (3,)

    def by_motion(self) -> Array:
        """The numbers (5, 6) that a motion makes: mm (3) at the entry point, degrees (3) about it, along LPS."""
        rows = np.zeros((5, 6))
        rows[:3, :3] = np.eye(3)
        along = self.target - self.entry
        for row, way in zip(rows[3:], end_axes(self.entry, self.target), strict=True):
            row[3:] = np.radians(np.cross(along, way))
        return rows

    def under(self, covariance: Array) -> "Quoted":
        """The gain under normal errors of mean 0 and a covariance (6, 6), mm and degrees.

        Exact for a quadratic: E = g + tr(C Σ) / 2, Var = b′ Σ b + tr(C Σ C Σ) / 2. That is var(x′Ax) = 2 tr(AΣAΣ) with
        A = C / 2 (Searle, Linear Models, 1971, p. 57); a linear term adds b′Σb, as odd moments vanish at mean 0.
        """
        spread = self.by_motion() @ np.asarray(covariance, float) @ self.by_motion().T
        bent = self.curvature[:, None] * spread
        mean = self.gain_percent + np.trace(bent) / 2
        variance = self.slope @ spread @ self.slope + np.trace(bent @ bent) / 2
        farthest = float(np.sqrt(np.diagonal(spread).max()))
        within = 2 * farthest <= self.distance_mm
        return Quoted(float(mean), float(np.sqrt(max(variance, 0.0))), self.gain_percent, farthest, within)


@dataclass(frozen=True)
class Quoted:
    """What a registration's uncertainty leaves of a plan's gain."""

    gain_percent: float
    deviation_percent: float
    planned_percent: float
    deviation_mm: float  # the largest of the path's five numbers
    within: bool  # two standard deviations lie where the plan's response was computed

    @property
    def sentence(self) -> str:
        """For people."""
        told = (
            f"At this uncertainty ({self.deviation_mm:.2f} mm along the path's worst axis) the modelled gain is "
            f"{self.gain_percent:.0f} ± {self.deviation_percent:.1f} % ({self.planned_percent:.0f} % as planned)."
        )
        return told if self.within else f"{told} Errors reach beyond the offsets that the plan was computed for."


def fit_response(
    planned_percent: float,
    gains_percent: Mapping[str, float],
    distance_mm: float,
    entry: Array,
    target: Array,
    side: str,
) -> Response:
    """The quadratic through the gains of the six directions and of the four turned ends."""
    medial, lateral = ("right", "left") if side == "left" else ("left", "right")
    named = dict(gains_percent) | {medial: gains_percent["medial"], lateral: gains_percent["lateral"]}
    plus, minus = (np.array([named[pair[n]] for pair in _PAIRS]) for n in (0, 1))
    slope = (plus - minus) / (2 * distance_mm)
    curvature = (plus - 2 * planned_percent + minus) / distance_mm**2
    return Response(planned_percent, slope, curvature, distance_mm, np.asarray(entry), np.asarray(target))


def response_content(response: Response) -> dict[str, Any]:
    """What `plan.json` holds of it, under `response`; entry point and target stand there already."""
    return {
        "of": ["x_mm", "y_mm", "z_mm", "end_up_mm", "end_front_mm"],
        "gain_percent": response.gain_percent,
        "slope_percent_per_mm": response.slope,
        "curvature_percent_per_mm2": response.curvature,
        "distance_mm": response.distance_mm,
    }


def read_response(file: File) -> Response | None:
    """The response in a `plan.json`; None if `femoreg plan-offsets` was not run on it. Raises `InputError`."""
    content = read_json(file)
    found = content.get("response")
    if found is None:
        return None
    try:
        slope, curvature = (
            np.array(found[key], float) for key in ("slope_percent_per_mm", "curvature_percent_per_mm2")
        )
        entry, target = (np.array(content["plan"][key], float) for key in ("entry_point", "target"))
        made = Response(float(found["gain_percent"]), slope, curvature, float(found["distance_mm"]), entry, target)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}, response: is not what `femoreg plan-offsets` writes ({error}).") from error
    if slope.shape != (5,) or curvature.shape != (5,):
        raise InputError(
            f"{file}, response: five slopes and five curvatures were expected. Run `femoreg plan-offsets`."
        )
    return made


def gains(outcomes: Mapping[str, Outcome], baseline_n: float) -> dict[str, float]:
    """Gains over a load, %."""
    return {name: 100 * (outcome.yield_load_n / baseline_n - 1) for name, outcome in outcomes.items()}
