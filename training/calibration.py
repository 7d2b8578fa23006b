"""What a confidence is worth: how often landmarks of a stated confidence are where they are said to be."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from femoreg_torch.files import temporary_file
from training.measure import Array, Reading

RIGHT_MM = 12.4  # 4 pixels of the heat map: the window whose probability the confidence is
_BINS = 10


def reliability(readings: Sequence[Reading]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Mean confidence, share that is right, and number of landmarks of the N bins, of ten, that hold any: (N,) each.

    A landmark is right if it is in the image and less than 12.4 mm from where it was found.
    """
    confidence = np.concatenate([reading.confidence for reading in readings])
    right = np.concatenate([reading.visible & (reading.error_mm < RIGHT_MM) for reading in readings])
    which = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    number = np.bincount(which, minlength=_BINS)
    full = number > 0
    stated = np.bincount(which, confidence, _BINS)[full] / number[full]
    true = np.bincount(which, right, _BINS)[full] / number[full]
    return stated, true, number[full]


def calibration_error(readings: Sequence[Reading]) -> float:
    """Expected calibration error: |confidence − share that is right| of the bins, averaged over landmarks."""
    stated, true, number = reliability(readings)
    return float((np.abs(stated - true) * number).sum() / number.sum())


def draw_reliability(readings: Sequence[Reading], picture: Path) -> None:
    """Reliability diagram as PNG: the share that is right over the stated confidence."""
    stated, true, _ = reliability(readings)
    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linestyle=":")
    axes.plot(stated, true, marker="o")
    axes.set(xlabel="stated confidence", ylabel="share that is right", xlim=(0, 1), ylim=(0, 1))
    axes.grid(alpha=0.3)
    with temporary_file(picture) as part:
        figure.savefig(part, dpi=110)
