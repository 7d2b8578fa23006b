"""Where the projector looks along its rays: at steps that go along with the volume.

With samples at the same distances from the source wherever the volume lies, these slide through the voxels as it moves
in depth. The error of the sum then rises and falls with every step of depth, in all rays at once, and a registration is
caught in ripples of its cost: in depth by some tenths of a millimetre. So samples are counted from the middle of the
volume, and all keep their places in it but for some hundredths of a millimetre.
"""

import torch
from torch import Tensor

from femoreg_torch.geometry.rigid import transform_points
from femoreg_torch.volume.grid import Volume

# Voxels from the grid point at the middle. On the grid itself interpolated values have a kink, and no derivative.
_OFF_GRID = 0.25


def middle_index(volume: Volume) -> list[float]:
    """Homogeneous index (x, y, z, 1) of about the middle of a volume."""
    return [(n - 1) // 2 + _OFF_GRID for n in reversed(volume.data.shape)] + [1.0]


def middle_of(volume: Volume, camera_from_volume: Tensor) -> Tensor:
    """About the middle of a volume in the camera frame, (B, 3) mm float64, for poses (B, 4, 4), where these are."""
    middle = transform_points(volume.lps_from_index, torch.tensor([middle_index(volume)[:3]], dtype=torch.float64))
    there = middle.to(camera_from_volume.device, non_blocking=True)
    return transform_points(camera_from_volume.to(torch.float64), there)[:, 0]


def offsets_of(middle: Tensor, step_mm: float) -> Tensor:
    """Distances (B,) mm of the first sample of every ray from the source, for volumes about `middle` (B, 3) mm.

    So far, and so many whole steps, is it to the middle.
    """
    return middle.norm(dim=-1).remainder(step_mm)
