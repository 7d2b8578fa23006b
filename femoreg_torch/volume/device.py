"""Devices given as voxels: labelled, or a scan in HU. The file's LPS mm are the device's own space."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.volume.attenuation import hu_to_attenuation
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.labels import label_box
from femoreg_torch.volume.reading import read_volume
from femoreg_torch.volume.resample import crop, resample_isotropic

_AIR_HU = -1000.0
_EDGE_SIGMA = 0.35  # voxels; softens the staircase at a label's edge, keeps its volume
_MARGIN = 3  # empty voxels around a device: the reach of the Gaussian (truncated at four deviations), and one more
_EMPTY_HU = -500.0  # half-way between air and water: below it a voxel counts as empty


def labelled_device(path: Path, ids: Sequence[int], hu: float, spacing_mm: float) -> Volume:
    """Attenuation (1/mm) of a solid of `hu` in the voxels with these label `ids`, HU counted from air.

    Grid and errors are those of `label_share`.
    """
    share = label_share(path, ids, spacing_mm)
    return share.with_data(share.data * hu_to_attenuation(torch.tensor(float(hu)), _AIR_HU))


def label_share(path: Path, ids: Sequence[int], spacing_mm: float) -> Volume:
    """How much of each voxel belongs to these label `ids`, 0 to 1, cropped.

    The edge is softened over a voxel, where a voxelised mesh has partial volumes; voxels finer than `spacing_mm`
    are averaged to it. Raises `InputError` for labels that are not whole numbers, or if one of the ids does not occur.
    """
    volume = read_volume(path)
    if not (volume.data == volume.data.round()).all():
        raise InputError(f"{path}: whole numbers were expected as labels. Without `labels` the volume is taken as HU.")
    present = set(volume.data.unique().long().tolist())
    if missing := [n for n in ids if n not in present]:
        raise InputError(f"{path}: no voxel carries label {missing[0]}; labels there: {sorted(present - {0})}.")
    inside = volume.with_data(torch.from_numpy(np.isin(volume.data.numpy(), list(ids))).float())
    padded = _padded_to_content(inside, inside.data > 0)
    soft = torch.from_numpy(ndimage.gaussian_filter(padded.data.numpy(), _EDGE_SIGMA)).clamp(0, 1)
    share = padded.with_data(soft)
    return resample_isotropic(share, spacing_mm) if min(volume.spacing_mm) < spacing_mm else share


def scanned_device(path: Path) -> Volume:
    """Attenuation (1/mm) of a device scanned by itself, in HU, HU counted from air; empty voxels around it cropped.

    Raises `InputError` if nothing is denser than air, or if the device is not in air: what lies around it would be
    drawn with it.
    """
    volume = read_volume(path)
    solid = volume.data > _EMPTY_HU
    if not solid.any():
        raise InputError(
            f"{path}: no voxel is above {_EMPTY_HU:g} HU; a device in HU was expected, air at {_AIR_HU:g}."
        )
    faces = torch.cat([face.flatten() for axis in range(3) for face in (solid.select(axis, 0), solid.select(axis, -1))])
    if faces.float().mean() > 0.5:
        raise InputError(
            f"{path}: most of its outer faces are above {_EMPTY_HU:g} HU; a device in air ({_AIR_HU:g} HU) was "
            "expected. If these are labels, say which belong to the device by `labels`."
        )
    attenuation = hu_to_attenuation(volume.data, _AIR_HU) * torch.from_numpy(ndimage.binary_dilation(solid.numpy()))
    return _padded_to_content(volume.with_data(attenuation), solid)


def _padded_to_content(volume: Volume, content: torch.Tensor) -> Volume:
    """The box of `content` (Z, Y, X) with a margin of zeros, also where the box touches the edge of the grid."""
    low, high = label_box(volume.with_data(content.byte()), [1])
    part = crop(volume, low, high)
    affine = part.lps_from_index.clone()
    affine[:3, 3] -= affine[:3, :3] @ torch.full((3,), float(_MARGIN), dtype=torch.float64)
    return Volume(torch.nn.functional.pad(part.data, (_MARGIN,) * 6), affine)
