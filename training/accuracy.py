"""Figures of many readings, with intervals.

Errors are over the landmarks in the image that were found; misses and false finds are counted beside them. Confidence
intervals are percentiles of a bootstrap over patients, because images of one patient are no independent evidence.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.anatomy import HIP
from training.measure import Reading

GROSS_MM = 20.0
NEAR_MM = 10.0
FAIR = (5.0, 10.0, 50.0)  # degrees, mm across, mm in depth
COARSE = (10.0, 20.0, 100.0)
REGISTERED_DEG = 1.0
_REDRAWS = 2000


@dataclass(frozen=True)
class Measure:
    """A figure and its 95 % confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class LandmarkAccuracy:
    """How well one landmark is found."""

    mean_mm: float
    median_mm: float
    recall: float
    in_image: int  # number of images that show it


@dataclass(frozen=True)
class Accuracy:
    """Figures of a set of readings; nan where nothing could be counted."""

    images: int
    patients: int
    measures: dict[str, Measure]
    landmarks: dict[str, LandmarkAccuracy]


def summarise(readings: Sequence[Reading], seed: int = 0) -> Accuracy:
    """All figures with their intervals, and the accuracy of each landmark."""
    patients = sorted({reading.patient for reading in readings})
    groups = [[reading for reading in readings if reading.patient == patient] for patient in patients]
    value = figures(readings)
    rng = np.random.default_rng(seed)
    # Not scipy's bootstrap: a figure may be missing (nan) in some redraws, and of few patients most are the same.
    redraws = Counter(tuple(sorted(rng.integers(len(groups), size=len(groups)))) for _ in range(_REDRAWS))
    drawn: dict[str, list[float]] = {name: [] for name in value}
    for redraw, times in redraws.items():
        for name, figure in figures([reading for n in redraw for reading in groups[n]]).items():
            drawn[name] += [figure] * times
    measures = {name: _measure(figure, drawn[name]) for name, figure in value.items()}
    return Accuracy(len(readings), len(patients), measures, _per_landmark(readings))


def _measure(value: float, drawn: list[float]) -> Measure:
    if not np.isfinite(drawn).any():
        return Measure(value, np.nan, np.nan)
    low, high = np.nanquantile(drawn, (0.025, 0.975))
    return Measure(value, float(low), float(high))


def figures(readings: Sequence[Reading]) -> dict[str, float]:
    """All figures of one or more readings; nan where nothing could be counted."""
    error, found, visible = (
        np.stack([getattr(r, name) for r in readings]) for name in ("error_mm", "found", "visible")
    )
    hits = error[found & visible]
    overlap, total = np.stack([r.overlap for r in readings]).sum(0).T
    dice = overlap / np.where(total > 0, total, np.nan)
    poses = np.array([r.pose_error for r in readings if r.asked]).reshape(-1, 3)
    refused = np.array([r.refused for r in readings if r.asked])
    registered = np.array([r.registered_error for r in readings if r.asked and r.registered_error is not None])
    return {
        "mean_mm": _of(np.mean, hits),
        "median_mm": _of(np.median, hits),
        "p90_mm": _of(lambda v: np.quantile(v, 0.9), hits),
        "gross": _of(np.mean, hits > GROSS_MM),
        "recall": _of(np.mean, found[visible]),
        "false_positives": _of(np.mean, found[~visible]),
        "within_10mm": _of(np.mean, (found & (error < NEAR_MM))[visible]),
        **{f"dice_{bone}": float(value) for bone, value in zip(HIP.bone_names, dice, strict=True)},
        "dice_mean": float(dice.mean()),
        "pose_fair": _of(np.mean, np.all(poses < np.array(FAIR), axis=1)),
        "pose_coarse": _of(np.mean, np.all(poses < np.array(COARSE), axis=1)),
        "pose_refused": _of(np.mean, refused),
        "registered_1deg": _of(np.mean, registered.reshape(-1, 3)[:, 0] < REGISTERED_DEG),
        "rotation_median_deg": _of(np.median, poses[np.isfinite(poses[:, 0]), 0]),
    }


def _of(statistic: Callable[[NDArray[Any]], Any], values: NDArray[Any]) -> float:
    return float(statistic(values)) if values.size else float("nan")


def _per_landmark(readings: Sequence[Reading]) -> dict[str, LandmarkAccuracy]:
    error, found, visible = (
        np.stack([getattr(r, name) for r in readings]) for name in ("error_mm", "found", "visible")
    )
    table = {}
    for n, name in enumerate(HIP.landmark_names):
        hits = error[:, n][found[:, n] & visible[:, n]]
        recall = _of(np.mean, found[:, n][visible[:, n]])
        table[name] = LandmarkAccuracy(_of(np.mean, hits), _of(np.median, hits), recall, int(visible[:, n].sum()))
    return table
