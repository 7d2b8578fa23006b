"""Is the projector right on a device? Line integrals of a Gaussian ball against their formula, and how fast it is.

A ball exp(−r² / 2σ²) has the line integral σ √(2π) exp(−d² / 2σ²) along a ray at the distance d from its middle.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.drr.operator import project, project_with_jacobian
from femoreg_torch.geometry import Camera, centred_camera, exp_se3, rigid
from femoreg_torch.volume.grid import Volume, axis_aligned

_SIGMA_MM = 16.0
_VOXELS = 160  # along each edge: five deviations to each side
_SPACING_MM = 1.0
_PLACE_MM = (12.0, -7.0, 640.0)
_TURN = (0.3, -0.5, 0.2)
_STEP_MM = 0.5
_CAMERA = centred_camera(1020.0, (3.1, 3.1), (96, 96))
MOST_ERROR, MOST_SLOPE_ERROR = 1e-3, 1e-2  # of the largest value: mostly those of trilinear interpolation


@dataclass(frozen=True)
class Parity:
    """Largest deviations from the formula, relative to the largest value."""

    image: float
    derivative: float  # by a shift along x

    @property
    def holds(self) -> bool:
        """Whether the projector is right; nan counts as wrong."""
        return self.image <= MOST_ERROR and self.derivative <= MOST_SLOPE_ERROR


def parity(device: torch.device) -> Parity:
    """Compare images and derivatives of the projector on a device with the formula."""
    volume, pose = _ball(device), _pose(device)
    with torch.no_grad():
        image = project(volume, pose, _CAMERA, _STEP_MM)[0].double().cpu()
        _, jacobian = project_with_jacobian(volume, pose, _CAMERA, pose[0, :3, 3], _STEP_MM)
    slope = jacobian[0, ..., 3].double().cpu()
    step = 1e-3
    middle = torch.tensor(_PLACE_MM, dtype=torch.float64)
    exact = _line_integrals(_CAMERA, middle)
    aside = torch.tensor([step, 0, 0], dtype=torch.float64)
    true_slope = (_line_integrals(_CAMERA, middle + aside) - _line_integrals(_CAMERA, middle - aside)) / (2 * step)
    return Parity(_apart(image, exact), _apart(slope, true_slope))


def milliseconds(device: torch.device, seconds: float = 3.0) -> tuple[float, float]:
    """Median time of an image of 384 × 384 pixels through 160³ voxels, and of one with its derivatives."""
    volume, pose = _ball(device), _pose(device)
    camera = centred_camera(1020.0, (0.776, 0.776), (384, 384))

    def image() -> None:
        project(volume, pose, camera)

    def derivatives() -> None:
        project_with_jacobian(volume, pose, camera, pose[0, :3, 3])

    with torch.no_grad():
        return _median_ms(image, device, seconds), _median_ms(derivatives, device, seconds)


def _median_ms(work: Callable[[], None], device: torch.device, seconds: float) -> float:
    times: list[float] = []
    began = time.perf_counter()
    work()
    while time.perf_counter() - began < seconds or len(times) < 3:
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return 1000 * sorted(times)[len(times) // 2]


def _ball(device: torch.device) -> Volume:
    """A ball in the middle of a cube of voxels, that is at the origin."""
    reach = (_VOXELS - 1) / 2 * _SPACING_MM
    axis = torch.linspace(-reach, reach, _VOXELS, dtype=torch.float64)
    squared = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    data = torch.exp(-squared / (2 * _SIGMA_MM**2)).float().to(device)
    return Volume(data, axis_aligned((_SPACING_MM,) * 3, (-reach,) * 3))


def _pose(device: torch.device) -> Tensor:
    """The pose (1, 4, 4) of the ball."""
    turn = exp_se3(torch.tensor([*_TURN, 0, 0, 0], dtype=torch.float64)[None])[0]
    return (rigid(translation=torch.tensor(_PLACE_MM, dtype=torch.float64)) @ turn)[None].to(device)


def _line_integrals(camera: Camera, middle: Tensor) -> Tensor:
    """The formula for a ball at `middle` (3,), mm in the camera: (H, W) float64."""
    ray = camera.pixel_positions(torch.float64)
    ray = ray / ray.norm(dim=-1, keepdim=True)
    squared = middle.square().sum() - (ray @ middle) ** 2
    return _SIGMA_MM * math.sqrt(2 * math.pi) * torch.exp(-squared / (2 * _SIGMA_MM**2))


def _apart(found: Tensor, exact: Tensor) -> float:
    return float((found - exact).abs().max() / exact.abs().max())
