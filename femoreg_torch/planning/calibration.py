"""HU into ash density: by the rods of a phantom, by air, fat and muscle of the patient, or not calibrated at all."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.planning.settings import CalibrationSettings

Array = NDArray[np.float64]

# Ash density in mg/cc = slope × density of the mineral + intercept: of hydroxyapatite by Keyak et al. 2005, of
# K2HPO4 by Keyak et al. 1994, as both stand in public code.
_ASH = {"ha": (0.887, 63.3), "k2hpo4": (1.06, 38.9)}
_WINDOWS_HU = {"air": (-1024, -900), "fat": (-150, -50), "muscle": (20, 90)}  # where the peaks of a CT lie
_LEAST_SHARE = 0.002  # of the voxels, in a window: less is no tissue but the rim of another
_RIM_HU = 3  # a peak so close to the rim of its window is the slope of another
_PADDING_HU = -1024  # the least value of 12 bits: what lies beyond a scanner's round field of view


@dataclass(frozen=True)
class Calibration:
    """Ash density in g/cc is `slope` × HU + `intercept`."""

    kind: str  # phantom, internal or uncalibrated
    slope: float
    intercept: float
    references: dict[str, tuple[float, float]]  # HU and mg/cc that the line was fitted to

    def ash_density(self, hu: Array) -> Array:
        """Ash density in g/cc, not below 0."""
        return np.maximum(self.slope * hu + self.intercept, 0.0)


def calibrate(hu: NDArray[np.float32], settings: CalibrationSettings) -> Calibration:
    """The calibration of a CT (X, Y, Z) in HU.

    Internal: the line through the peaks of air, fat and muscle in the histogram of the whole CT (Eggermont et al. 2019,
    PLoS ONE 14:e0220564); their densities are settings whose defaults no source confirmed. Uncalibrated: HU are taken
    for mg/cc of hydroxyapatite, which holds for no scanner exactly.
    Raises `InputError` if a peak is missing or density does not rise with HU.
    """
    references: dict[str, tuple[float, float]] = {}
    if settings.kind == "phantom":
        references = {f"rod {n}": rod for n, rod in enumerate(settings.rods, 1)}
    elif settings.kind == "internal":
        known = dict(zip(_WINDOWS_HU, settings.air_fat_muscle_mg_cc, strict=True))
        references = {tissue: (_peak(hu, tissue), density) for tissue, density in known.items()}
    slope, intercept = (1.0, 0.0) if not references else _line(list(references.values()))
    if slope <= 0:
        raise InputError("calibration: density falls where HU rise. Check the rods' HU and densities.")
    to_ash, at_zero = _ASH[settings.mineral]
    return Calibration(settings.kind, to_ash * slope / 1000, (to_ash * intercept + at_zero) / 1000, references)


def _line(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    slope, intercept = np.polyfit([hu for hu, _ in pairs], [density for _, density in pairs], 1)
    return float(slope), float(intercept)


def _peak(hu: NDArray[np.float32], tissue: str) -> float:
    """The most frequent HU of a tissue, of a histogram smoothed by 3 HU.

    Padding is no air, where there is other air: of a CT that has it in its corners bone was 2.4 % less dense.
    """
    low, high = _WINDOWS_HU[tissue]
    counts = np.histogram(hu, bins=np.arange(low - 10, high + 12) - 0.5)[0].astype(float)
    inside = slice(10, len(counts) - 10)
    if tissue == "air" and counts[inside][_PADDING_HU - low + 1 :].sum() >= _LEAST_SHARE * hu.size:
        counts[: 10 + _PADDING_HU - low + 1] = 0
    best = int(ndimage.gaussian_filter1d(counts, 3, mode="nearest")[inside].argmax())
    rim = min(best, high - low - best) < _RIM_HU and tissue != "air"
    if counts[inside].sum() < _LEAST_SHARE * hu.size or rim:
        raise InputError(
            f"calibration: the CT has no peak of {tissue} between {low} and {high} HU. Give the rods of a phantom "
            "(`kind: phantom`), or accept loads that are not calibrated (`kind: uncalibrated`)."
        )
    return float(low + best)
