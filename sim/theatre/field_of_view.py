"""The part of a CT that the C-arm sees."""

from collections.abc import Sequence

import torch
from torch import Tensor

from femoreg_torch.geometry import Camera, invert_rigid, transform_points
from femoreg_torch.volume import Volume, crop


def field_of_view(volume: Volume, camera_from_lps: Sequence[Tensor] | Tensor, camera: Camera, room_mm: float) -> Volume:
    """The part of a volume that any of the poses (4, 4) shows on the detector, with `room_mm` around it.

    Where it reaches beyond the first or last slice, that slice is repeated: a patient does not end where the CT ends.
    """
    index_from_lps = torch.linalg.inv(volume.lps_from_index)
    last = torch.tensor(volume.data.shape[::-1], dtype=torch.float64) - 1
    corners_index = torch.cartesian_prod(*(torch.tensor([0.0, n], dtype=torch.float64) for n in last.tolist()))
    corners = transform_points(volume.lps_from_index, corners_index)
    rows, columns = camera.shape
    rays = camera.window(slice(0, rows, max(1, rows - 1)), slice(0, columns, max(1, columns - 1))).pixel_positions()
    rays = rays.reshape(-1, 3) / camera.sdd_mm
    seen = []
    for pose in camera_from_lps:
        depth = transform_points(pose, corners)[:, 2]
        frustum = torch.cat([rays * depth.min(), rays * depth.max()])
        seen.append(transform_points(index_from_lps @ invert_rigid(pose), frustum))
    points = torch.cat(seen)
    room = room_mm / torch.tensor(volume.spacing_mm, dtype=torch.float64)
    low = (points.amin(0) - room).floor().int().tolist()
    high = (points.amax(0) + room).ceil().int().tolist()
    part = crop(volume, (low[0], low[1], low[2]), (high[0] + 1, high[1] + 1, high[2] + 1))
    below, above = max(0, -low[2]), max(0, high[2] + 1 - volume.data.shape[0])
    if not below and not above:
        return part
    slices = [part.data[:1].expand(below, -1, -1), part.data, part.data[-1:].expand(above, -1, -1)]
    affine = part.lps_from_index.clone()
    affine[:3, 3] -= below * affine[:3, 2]
    return Volume(torch.cat(slices), affine)
