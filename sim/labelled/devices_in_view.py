"""Drilling devices brought into labelled views."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.geometry import about_point, exp_so3, rigid
from femoreg_torch.volume import Volume
from sim.labelled.settings import DeviceRanges, LabelledSettings
from sim.physics.line_integrals import device_density
from sim.theatre.device import make_device
from sim.theatre.nominal_poses import nominal_device


@dataclass(frozen=True)
class PosableDevice:
    """A device that can be brought into view."""

    density: Volume
    mesh: trimesh.Trimesh
    points: dict[str, Tensor]


def make_devices(settings: LabelledSettings) -> list[PosableDevice]:
    """The devices of the first seeds."""
    step_mm, hu = settings.image.step_mm, settings.device.hu
    made = [make_device(seed) for seed in range(settings.device.count)]
    return [PosableDevice(device_density(mesh, step_mm, hu), mesh, points) for mesh, points in made]


def device_pose(
    mesh: trimesh.Trimesh, points: dict[str, Tensor], ranges: DeviceRanges, rng: np.random.Generator
) -> Tensor:
    """Pose (4, 4): the guide in any direction across the image, then leaning and moved aside."""
    direction = rng.uniform(0, 2 * np.pi)
    across = torch.tensor([np.cos(direction), np.sin(direction), 0.0], dtype=torch.float64)
    depth = rng.uniform(*ranges.depth_mm)
    nominal = nominal_device(mesh, points, across, depth)
    axis = F.normalize(torch.from_numpy(rng.standard_normal(3)), dim=0)
    angle = np.radians(rng.uniform(-ranges.angle_deg, ranges.angle_deg))
    middle = torch.tensor([0.0, 0.0, depth], dtype=torch.float64)
    shift = torch.tensor([*rng.uniform(-ranges.shift_mm, ranges.shift_mm, 2), 0.0], dtype=torch.float64)
    return rigid(translation=shift) @ about_point(rigid(exp_so3(angle * axis)), middle) @ nominal
