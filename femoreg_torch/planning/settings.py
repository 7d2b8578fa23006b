"""Settings of a planner, read from `configs/planning/*.yaml`; there each value has its source."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError
from femoreg_torch.settings import read_record

_COARSEST_MM = 10.0  # of elements and voxels; a femoral neck is some 30 mm thick


@dataclass(frozen=True)
class CalibrationSettings:
    """How grey values become density."""

    kind: Literal["phantom", "internal", "uncalibrated"]
    rods: list[tuple[float, float]]  # HU, mg/cc
    mineral: Literal["ha", "k2hpo4"]
    air_fat_muscle_mg_cc: tuple[float, float, float]

    def __post_init__(self) -> None:
        if self.kind == "phantom" and len({hu for hu, _ in self.rods}) < 2:
            raise InputError(
                "calibration.rods: no calibration, at least two rods of different HU were expected as "
                "[HU, mg/cc]. Give them, or `kind: internal` or `uncalibrated`."
            )


@dataclass(frozen=True)
class BoneSettings:
    """Density into stiffness and strength."""

    law: Literal["keyak", "morgan"]
    poisson: float
    ash_of_apparent: float
    least_density_g_cc: float

    def __post_init__(self) -> None:
        if not 0 <= self.poisson < 0.5:
            raise InputError(f"bone.poisson: 0 to below 0.5 was expected, found {self.poisson:g}.")
        _positive("bone", ash_of_apparent=self.ash_of_apparent, least_density_g_cc=self.least_density_g_cc)


@dataclass(frozen=True)
class CementSettings:
    """Cement with the bone in it, MPa."""

    modulus_mpa: float
    strength_mpa: float

    def __post_init__(self) -> None:
        _positive("cement", modulus_mpa=self.modulus_mpa, strength_mpa=self.strength_mpa)


@dataclass(frozen=True)
class MeshSettings:
    """Hexahedra over the bone."""

    size_mm: float
    search_mm: float
    least_fill: float
    shaft_mm: float
    most_elements: int

    def __post_init__(self) -> None:
        _positive("mesh", size_mm=self.size_mm, shaft_mm=self.shaft_mm, most_elements=self.most_elements)
        _at_most("mesh", _COARSEST_MM, size_mm=self.size_mm)
        if self.search_mm < self.size_mm:
            raise InputError(
                f"mesh.search_mm: at least mesh.size_mm, {self.size_mm:g}, was expected, found {self.search_mm:g}."
            )
        if not 0 < self.least_fill <= 1:
            raise InputError(f"mesh.least_fill: above 0 and up to 1 was expected, found {self.least_fill:g}.")


@dataclass(frozen=True)
class LoadSettings:
    """What presses on the head and what holds the bone; angles in degrees."""

    kind: Literal["fall", "stance"]
    adduction_deg: float
    internal_rotation_deg: float
    stance_deg: float
    distal: Literal["perpendicular", "fixed"]
    pad_depth_mm: float
    pad_thickness_mm: float
    pad_modulus_mpa: float
    cap_mm: float

    def __post_init__(self) -> None:
        _within(
            "load",
            90,
            adduction_deg=self.adduction_deg,
            internal_rotation_deg=self.internal_rotation_deg,
            stance_deg=self.stance_deg,
        )
        _not_negative("load", cap_mm=self.cap_mm)
        _positive(
            "load",
            pad_depth_mm=self.pad_depth_mm,
            pad_thickness_mm=self.pad_thickness_mm,
            pad_modulus_mpa=self.pad_modulus_mpa,
        )


@dataclass(frozen=True)
class CurveSettings:
    """The load–displacement curve and where on it the bone yields."""

    rule: Literal["offset", "displacement", "pistoia"]
    offset_mm: float
    displacement_share: float
    pistoia_share: float
    pistoia_strain: float
    step_mm: float
    stop_stiffness: float
    longest_mm: float
    newton_steps: int
    tolerance: float

    def __post_init__(self) -> None:
        _positive(
            "curve",
            offset_mm=self.offset_mm,
            displacement_share=self.displacement_share,
            pistoia_share=self.pistoia_share,
            pistoia_strain=self.pistoia_strain,
            step_mm=self.step_mm,
            longest_mm=self.longest_mm,
            newton_steps=self.newton_steps,
            tolerance=self.tolerance,
        )
        if self.pistoia_share >= 1:
            raise InputError(f"curve.pistoia_share: below 1 was expected, found {self.pistoia_share:g}.")


@dataclass(frozen=True)
class DistributionSettings:
    """The free optimum of the cement."""

    criterion: Literal["limit_load", "compliance"]
    steps: int
    filter_mm: float
    clearance_mm: float
    lowest_mm: float
    cortex_g_cc: float

    def __post_init__(self) -> None:
        _not_negative("distribution", clearance_mm=self.clearance_mm)
        _positive("distribution", steps=self.steps, filter_mm=self.filter_mm, cortex_g_cc=self.cortex_g_cc)


@dataclass(frozen=True)
class PathSettings:
    """One drill path with ellipsoids of cement on it, and what it keeps away from."""

    target_mm: float
    angle_deg: float
    clearance_mm: float
    entry_free_mm: float
    tip_clearance_mm: float
    entry_angle_deg: float
    lowest_entry_mm: float
    ellipsoids: int
    least_axis_mm: float
    most_axis_mm: float
    evaluations: int
    polish: int
    compared: int
    fine: int

    def __post_init__(self) -> None:
        _positive(
            "path",
            ellipsoids=self.ellipsoids,
            least_axis_mm=self.least_axis_mm,
            evaluations=self.evaluations,
            compared=self.compared,
        )
        _not_negative(
            "path",
            target_mm=self.target_mm,
            angle_deg=self.angle_deg,
            clearance_mm=self.clearance_mm,
            entry_free_mm=self.entry_free_mm,
            tip_clearance_mm=self.tip_clearance_mm,
            entry_angle_deg=self.entry_angle_deg,
            polish=self.polish,
            fine=self.fine,
        )
        _within("path", 90, angle_deg=self.angle_deg, entry_angle_deg=self.entry_angle_deg)
        if self.most_axis_mm <= self.least_axis_mm:
            raise InputError("path.most_axis_mm: more than least_axis_mm was expected.")


@dataclass(frozen=True)
class DiffusionSettings:
    """How cement spreads in spongy bone."""

    voxel_mm: float
    across: float
    solid_g_cc: float
    rate_ml_min: float

    def __post_init__(self) -> None:
        _positive(
            "diffusion",
            voxel_mm=self.voxel_mm,
            across=self.across,
            solid_g_cc=self.solid_g_cc,
            rate_ml_min=self.rate_ml_min,
        )
        _at_most("diffusion", _COARSEST_MM, voxel_mm=self.voxel_mm)


@dataclass(frozen=True)
class OffsetSettings:
    """Offsets of a plan."""

    moves: Literal["path", "pattern"]
    distance_mm: float

    def __post_init__(self) -> None:
        _positive("offsets", distance_mm=self.distance_mm)


@dataclass(frozen=True)
class RobustnessSettings:
    """Random errors of a plan."""

    draws: int

    def __post_init__(self) -> None:
        _positive("robustness", draws=self.draws)


@dataclass(frozen=True)
class Planning:
    """All settings of a planner."""

    calibration: CalibrationSettings
    bone: BoneSettings
    cement: CementSettings
    mesh: MeshSettings
    load: LoadSettings
    curve: CurveSettings
    distribution: DistributionSettings
    path: PathSettings
    diffusion: DiffusionSettings
    offsets: OffsetSettings
    robustness: RobustnessSettings


def load_planning(preset: str | Path = "default") -> Planning:
    """The settings `configs/planning/<preset>.yaml`, or those of a YAML file.

    Raises `InputError` that names the key.
    """
    return read_record(Planning, load_preset("planning", preset), f"planning preset {preset}")


def _positive(group: str, **values: float) -> None:
    for key, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{group}.{key}: a number above 0 was expected, found {value:g}.")


def _at_most(group: str, most: float, **values: float) -> None:
    for key, value in values.items():
        if value > most:
            raise InputError(f"{group}.{key}: at most {most:g} was expected, found {value:g}.")


def _not_negative(group: str, **values: float) -> None:
    for key, value in values.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{group}.{key}: 0 or more was expected, found {value:g}.")


def _within(group: str, most: float, **values: float) -> None:
    for key, value in values.items():
        if not abs(value) <= most:
            raise InputError(f"{group}.{key}: −{most:g} to {most:g} was expected, found {value:g}.")
