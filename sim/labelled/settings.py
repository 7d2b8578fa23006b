"""Settings of labelled images at full physics strength (`configs/simulation/labelled.yaml`)."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from femoreg_torch.configs import load_preset

from femoreg_torch.settings import check_rising, check_within, read_record
from sim.labelled.view_poses import ViewRanges
from sim.physics.fluoroscopy import XRAY_RANGES, XrayModel

Range = float | tuple[float, float]  # a value, or low and high


@dataclass(frozen=True)
class DeviceRanges:
    """How the device comes into view."""

    share: float  # of the views
    count: int  # different devices
    hu: float
    depth_mm: tuple[float, float]  # source to its middle
    shift_mm: float  # of its middle from the central ray, across and along
    angle_deg: float  # out of the plane of the detector; in that plane it points anywhere

    def __post_init__(self) -> None:
        check_within(
            self,
            share=(0, 1),
            count=(0, 1000),
            hu=(-1000, 100_000),
            depth_mm=(50, 2500),
            shift_mm=(0, 1000),
            angle_deg=(0, 180),
        )
        check_rising(self, "depth_mm")


@dataclass(frozen=True)
class XrayRanges:
    """Tube and detector of labelled images: `XrayModel`, where a pair is drawn anew for every view.

    Draws are uniform, but for the dose, which is log-uniform.
    """

    kvp: Range
    aluminium_mm: Range
    energy_bins: int
    k_lines: Range
    dose_ugy: Range
    quantum_efficiency: Range
    inverse_square: bool
    heel: Range
    collimator_mm: Range
    scatter: Range
    scatter_sigma_mm: Range
    motion_mm: Range
    blur_sigma_mm: Range
    electronic_noise: Range
    gain_spread: Range
    open_beam_counts: Range

    def __post_init__(self) -> None:
        check_within(self, **XRAY_RANGES)
        check_rising(self, *XRAY_RANGES)

    def draw(self, rng: np.random.Generator) -> XrayModel:
        """The tube and the detector of one view."""
        drawn: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, tuple):
                drawn[field.name] = value
            elif field.name == "dose_ugy":
                drawn[field.name] = float(np.exp(rng.uniform(*np.log(value))))
            else:
                drawn[field.name] = float(rng.uniform(*value))
        return XrayModel(**drawn)


@dataclass(frozen=True)
class ImageGrid:
    """How fine the images are."""

    binning: int  # pixels of the detector in one of the image, along each side
    step_mm: float  # of the line integrals

    def __post_init__(self) -> None:
        check_within(self, binning=(1, 64), step_mm=(0.05, 20))


@dataclass(frozen=True, kw_only=True)
class LabelledSettings:
    """Settings of labelled images; their meaning is told in `configs/simulation/labelled.yaml`."""

    views: ViewRanges
    device: DeviceRanges
    image: ImageGrid
    xray: XrayRanges
    carm: str = "cios_fusion"  # a preset or YAML file


def load_labelled_settings(config: str | Path) -> LabelledSettings:
    """Settings of a preset in `configs/simulation/` or of a YAML file. Raises `InputError` that names the key."""
    return read_record(LabelledSettings, load_preset("simulation", config), f"labelled images {config}")
