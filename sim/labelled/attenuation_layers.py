"""A CT taken apart into what can be moved and weighted one by one: soft tissue and the attenuation of each bone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.volume import (
    Volume,
    hu_to_attenuation,
    resample_isotropic,
    structure_attenuation,
)
from sim.labelled.prolonged import prolonged

_SOFT_HU = 50.0  # bone is the attenuation above this one
_TISSUE_MM = 3.0
_RIM_MM = 2.0  # partial-volume rim of a bone outside its label
_FIELD_STEP = 4  # voxels between the points where a displacement is computed; linear between them
_BEYOND_MM = 100.0  # of the first and the last slice repeated below and above the scan: a cut femur goes on

Displacement = Callable[[Tensor], Tensor]  # points (..., 3) in LPS mm to shifts (..., 3) in mm


@dataclass(frozen=True)
class Layers:
    """One patient as volumes that add up to the CT's attenuation (1/mm) where nothing has moved."""

    tissue: Volume
    bones: dict[str, Volume]  # attenuation above soft tissue, by name; a bone that the CT lacks is absent
    masks: dict[str, Volume]  # 1 inside the bone
    landmarks: Tensor  # (L, 3) LPS mm, in the order of the anatomy's


def split_layers(ct: Volume, labels: Volume, landmarks: Mapping[str, Tensor], spacing_mm: float = 1.5) -> Layers:
    """Layers of a CT in HU and its label map (ids of the table `femoreg`) on the same grid.

    The patient goes on beyond the CT's ends as it is there. The bones are on voxels of `spacing_mm`. Raises
    `InputError` if one of them has nothing above soft tissue.
    """
    ct, labels = prolonged(ct, _BEYOND_MM), prolonged(labels, _BEYOND_MM)
    rim = max(1, round(_RIM_MM / min(ct.spacing_mm)))
    tissue = hu_to_attenuation(ct.data, -1000.0)
    bones, masks = {}, {}
    for name, ids in label_table("femoreg").items():
        inside = torch.isin(labels.data, torch.tensor(ids, dtype=labels.data.dtype))
        if not inside.any():
            continue
        bone = structure_attenuation(ct, labels, list(ids), grow_voxels=rim, offset_hu=_SOFT_HU)
        z, y, x = _slices(bone, ct)
        tissue[z, y, x] -= bone.data
        bones[name] = resample_isotropic(bone, spacing_mm)
        masks[name] = resample_isotropic(bone.with_data(inside[z, y, x].to(torch.float32)), spacing_mm)
    points = torch.stack([landmarks[name] for name in HIP.landmark_names])
    coarse = resample_isotropic(ct.with_data(tissue), _TISSUE_MM)
    return Layers(coarse, bones, masks, points)


def _slices(part: Volume, whole: Volume) -> tuple[slice, slice, slice]:
    """Where a crop lies in the volume it was cut from."""
    low = torch.linalg.inv(whole.lps_from_index) @ part.lps_from_index[:, 3]
    x, y, z = (round(v) for v in low[:3].tolist())
    depth, height, width = part.data.shape
    return slice(z, z + depth), slice(y, y + height), slice(x, x + width)


def smooth_displacement(
    rng: np.random.Generator, amplitude_mm: float = 4.0, wavelengths_mm: tuple[float, float] = (150.0, 400.0)
) -> Displacement:
    """A random smooth displacement field: 12 plane waves; `amplitude_mm` is its standard deviation along each axis."""
    count = 12
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = torch.from_numpy(2 * np.pi / rng.uniform(*wavelengths_mm, (count, 1)) * directions).float()
    phases = torch.from_numpy(rng.uniform(0, 2 * np.pi, count)).float()
    amplitudes = torch.from_numpy(rng.normal(size=(count, 3)) * amplitude_mm * np.sqrt(2 / count)).float()

    def displacement(points: Tensor) -> Tensor:
        single = points.to(torch.float32)
        return (torch.sin(single @ waves.T + phases) @ amplitudes).to(points.dtype)

    return displacement


def deform(layers: Layers, displacement: Displacement) -> Layers:
    """Another patient: what was at x + displacement(x) is now at x, for every volume and landmark alike."""
    landmarks = layers.landmarks
    for _ in range(50):  # fixed point of p = p_old − displacement(p); contracts, as the field is smooth
        landmarks = layers.landmarks - displacement(landmarks)
    tissue = _warped([layers.tissue], displacement)[0]
    bones, masks = {}, {}
    for name, bone in layers.bones.items():
        pair = [_padded(volume, (8, 8, 8)) for volume in (bone, layers.masks[name])]
        bones[name], masks[name] = _warped(pair, displacement)
    return Layers(tissue, bones, masks, landmarks)


def _warped(volumes: Sequence[Volume], displacement: Displacement) -> list[Volume]:
    """Volumes of one grid pulled back through the field, on that grid."""
    affine = volumes[0].lps_from_index.float()
    size = torch.tensor(volumes[0].data.shape).flip(0)
    coarse = [_FIELD_STEP * torch.arange(-(-(int(n) - 1) // _FIELD_STEP) + 1, dtype=torch.float32) for n in size]
    z, y, x = torch.meshgrid(coarse[2], coarse[1], coarse[0], indexing="ij")
    index = torch.stack([x, y, z], -1)
    points = index @ affine[:3, :3].T + affine[:3, 3]
    source = index + displacement(points) @ torch.linalg.inv(affine[:3, :3]).T
    unit = (2 * source + 1) / size - 1  # voxel centres at integers to grid_sample's −1 … 1 with align_corners=False
    fine = [_FIELD_STEP * (len(axis) - 1) + 1 for axis in reversed(coarse)]
    unit = F.interpolate(unit.movedim(-1, 0)[None], fine, mode="trilinear", align_corners=True)[0]
    depth, height, width = volumes[0].data.shape
    unit = unit[:, :depth, :height, :width].movedim(0, -1)
    data = F.grid_sample(torch.stack([volume.data for volume in volumes])[None], unit[None], align_corners=False)[0]
    return [volume.with_data(moved) for volume, moved in zip(volumes, data, strict=True)]


def _padded(volume: Volume, margin_xyz: tuple[int, int, int]) -> Volume:
    """The volume with so many voxels of zero more on both sides of each axis."""
    x, y, z = margin_xyz
    affine = volume.lps_from_index.clone()
    affine[:3, 3] -= affine[:3, :3] @ torch.tensor(margin_xyz, dtype=torch.float64)
    return Volume(F.pad(volume.data[None, None], (x, x, y, y, z, z))[0, 0], affine)
