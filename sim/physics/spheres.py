"""Small metal spheres in the beam, exactly: the chord of every ray, 2 · √(r² − d²), in place of voxels."""

import torch
from torch import Tensor

from femoreg_torch.geometry import Camera, project_points

_PARTS = 5  # a pixel's edge is cut into: its value is the mean of their rays
_ASIDE_PX = 2


def areal_spheres(centres: Tensor, radius_mm: float, density: float, camera: Camera) -> Tensor:
    """Mass per area (H, W) in g/cm² of spheres of a density in g/cm³ about `centres` (N, 3), mm in the camera frame.

    Parts of a sphere that fall beside the detector, and spheres at or behind the source, are not drawn.
    """
    image = torch.zeros(camera.shape, dtype=torch.float32)
    offsets = (torch.arange(_PARTS, dtype=torch.float64) + 0.5) / _PARTS - 0.5
    pixels = project_points(camera, centres.double())
    for centre, (column, row) in zip(centres.double(), pixels.tolist(), strict=True):
        if column != column:  # behind the source
            continue
        reach = radius_mm * camera.sdd_mm / (float(centre[2]) - radius_mm) / min(camera.pixel_mm) + _ASIDE_PX
        low, high = max(0, int(row - reach)), min(camera.shape[0], int(row + reach) + 2)
        left, right = max(0, int(column - reach)), min(camera.shape[1], int(column + reach) + 2)
        if low >= high or left >= right:
            continue
        rows = (torch.arange(low, high, dtype=torch.float64)[:, None] + offsets).flatten()
        columns = (torch.arange(left, right, dtype=torch.float64)[:, None] + offsets).flatten()
        x = (columns - camera.principal_point_px[0]) * camera.pixel_mm[1]
        y = (rows - camera.principal_point_px[1]) * camera.pixel_mm[0]
        rays = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x)), torch.full((len(y), len(x)), 1.0)], -1)
        rays[..., 2] = camera.sdd_mm
        across = torch.linalg.cross(rays, centre.expand_as(rays)).norm(dim=-1) / rays.norm(dim=-1)
        chords = 2 * (radius_mm**2 - across**2).clamp_min(0).sqrt()
        mean = chords.reshape(high - low, _PARTS, right - left, _PARTS).mean((1, 3))
        image[low:high, left:right] += (mean / 10 * density).float()
    return image
