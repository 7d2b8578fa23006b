"""A CT that goes on above and below its ends: a patient does not end where the CT ends."""

import torch

from femoreg_torch.volume import Volume


def prolonged(volume: Volume, by_mm: float) -> Volume:
    """The volume with its first and last slice repeated over `by_mm`, to the nearest slice."""
    slices = round(by_mm / volume.spacing_mm[2])
    data = volume.data
    data = torch.cat([data[:1].expand(slices, -1, -1), data, data[-1:].expand(slices, -1, -1)])
    affine = volume.lps_from_index.clone()
    affine[:3, 3] -= slices * affine[:3, 2]
    return Volume(data, affine)
