"""Where the projector looks along its rays: at whole multiples of a step that goes along with the volume.

With a step that is the same wherever the volume lies, samples slide through the voxels as it moves in depth. The error
of the sum then rises and falls with every step of depth, in all rays at once, and a registration is caught in ripples
of its cost: in depth by some tenths of a millimetre. So the step of each pose is a little shorter or longer, such that
a sample lies at the middle of the volume; those around it keep their places in it to some hundredths of a millimetre.
"""

import torch
from torch import Tensor

from femoreg_torch.geometry.rigid import transform_points
from femoreg_torch.volume.grid import Volume


# Voxels from the grid point at the middle. On the grid itself interpolated values have a kink, and no derivative.
_OFF_GRID = 0.25


def middle_of(volume: Volume, camera_from_volume: Tensor) -> Tensor:
    """About the middle of a volume in the camera frame, (B, 3) mm float64, for poses (B, 4, 4)."""
    device = volume.data.device
    size = torch.tensor(volume.data.shape[::-1], dtype=torch.float64).to(device, non_blocking=True)
    lps_from_index = volume.lps_from_index.to(device, torch.float64, non_blocking=True)
    middle = transform_points(lps_from_index, ((size[None] - 1) / 2).floor() + _OFF_GRID)
    return transform_points(camera_from_volume.to(device, torch.float64), middle)[:, 0]


def steps_of(middle: Tensor, step_mm: float) -> Tensor:
    """The steps (B,) mm nearest to `step_mm` that lead in a whole number from the source to `middle` (B, 3) mm.

    It is `step_mm` itself where that is nearer to the source than half a step.
    """
    distance = middle.norm(dim=-1)
    count = (distance.detach() / step_mm).round()
    return torch.where(count >= 1, distance / count.clamp(min=1), torch.full_like(distance, step_mm))


def step_rates(middle: Tensor, velocities: Tensor, step_mm: float) -> Tensor:
    """Rates (B, n) of the logarithms of the steps where the middle (B, 3) mm moves with velocities (B, n, 3)."""
    distance = middle.norm(dim=-1)
    rates = (velocities @ middle[:, :, None])[..., 0] / distance[:, None].square()
    return torch.where((distance / step_mm).round()[:, None] >= 1, rates, torch.zeros_like(rates))
