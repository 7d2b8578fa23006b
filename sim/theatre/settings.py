"""Settings of the simulated acquisition (`configs/simulation/`)."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from femoreg_torch.configs import load_preset
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3, rigid
from femoreg_torch.settings import check_within, read_record
from sim.physics.fluoroscopy import XrayModel


@dataclass(frozen=True)
class Motion:
    """A random rigid motion: angle uniform in ± `angle_deg` about a random axis, shift uniform in 0 to `shift_mm`."""

    angle_deg: float
    shift_mm: float

    def __post_init__(self) -> None:
        check_within(self, angle_deg=(0, 180), shift_mm=(0, 500))

    def draw(self, generator: torch.Generator) -> Tensor:
        """One motion (4, 4); axis and direction are uniform on the sphere."""
        angle, length = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        axis, direction = F.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
        return rigid(exp_so3(math.radians(self.angle_deg) * (2 * angle - 1) * axis), self.shift_mm * length * direction)


@dataclass(frozen=True)
class Acquisition:
    """Settings of the simulated acquisition; their meaning is told in `configs/simulation/paper.yaml`."""

    head_depth_mm: float
    head_lateral_mm: float
    head_caudal_mm: float
    orbit_deg: tuple[tuple[float, float], ...]  # mean and standard deviation per view
    view: Motion
    pelvis: Motion
    femur: Motion
    device: Motion
    device_hu: float
    device_depth_mm: float
    device_margin_mm: float
    step_mm: float
    device_materials: Literal["titanium", "mixed"] = "titanium"
    table_parts: bool = False
    moved_deg: float = 0.0
    moved_mm: float = 0.0
    device_moved_deg: float = 0.0
    device_moved_mm: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= len(self.orbit_deg) <= 100:
            raise InputError(f"orbit_deg: 1 to 100 views were expected, found {len(self.orbit_deg)}.")
        check_within(
            self,
            head_depth_mm=(100, 2500),
            head_lateral_mm=(-500, 500),
            head_caudal_mm=(-500, 500),
            orbit_deg=(-360, 360),
            device_hu=(-1000, 100_000),
            device_depth_mm=(50, 2500),
            device_margin_mm=(0, 200),
            step_mm=(0.05, 20),
            moved_deg=(0, 180),
            moved_mm=(0, 500),
            device_moved_deg=(0, 180),
            device_moved_mm=(0, 500),
        )


@dataclass(frozen=True)
class Simulation:
    """What `configs/simulation/paper.yaml` and its like hold."""

    acquisition: Acquisition
    xray: XrayModel
    carm: str | None = None  # a preset or YAML file, in place of the C-arm of the patient's case


def load_simulation(config: str | Path) -> Simulation:
    """Settings from a preset (`configs/simulation/`) or from a YAML file. Raises `InputError` that names the key."""
    return read_record(Simulation, load_preset("simulation", config), f"simulation settings {config}")
