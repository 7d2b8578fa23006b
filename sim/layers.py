"""A CT taken apart into what can be moved and weighted one by one: soft tissue and the attenuation of each bone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.volume import (
    HIP_LANDMARKS,
    Volume,
    hu_to_attenuation,
    resample_isotropic,
    structure_attenuation,
)

BONE_IDS = (1, 2, 3, 4, 5, 6)  # hip bones left and right, vertebrae, sacrum, femora left and right
_SOFT_HU = 50.0  # bone is the attenuation above this one
_TISSUE_MM = 3.0
_RIM_MM = 2.0  # partial-volume rim of a bone outside its label
_BEYOND = 30  # tissue voxels repeated above and below the scan, so that the patient does not end in mid-air

Displacement = Callable[[Tensor], Tensor]  # points (..., 3) in LPS mm to shifts (..., 3) in mm


@dataclass(frozen=True)
class Layers:
    """One patient as volumes that add up to the CT's attenuation (1/mm) where nothing has moved."""

    tissue: Volume
    bones: dict[int, Volume]  # label → attenuation above soft tissue; a label that the CT lacks is absent
    masks: dict[int, Volume]  # label → 1 inside the bone
    landmarks: Tensor  # (14, 3) LPS mm, in the order of HIP_LANDMARKS


def split_layers(ct: Volume, labels: Volume, landmarks: Mapping[str, Tensor], spacing_mm: float = 1.5) -> Layers:
    """Layers of a CT in HU and its label map on the same grid; bones on voxels of `spacing_mm`.

    Raises `InputError` if one of the labels has nothing above soft tissue.
    """
    present = [label for label in BONE_IDS if (labels.data == label).any()]
    rim = max(1, round(_RIM_MM / min(ct.spacing_mm)))
    tissue = hu_to_attenuation(ct.data, -1000.0)
    bones, masks = {}, {}
    for label in present:
        bone = structure_attenuation(ct, labels, [label], grow_voxels=rim, offset_hu=_SOFT_HU)
        z, y, x = _slices(bone, ct)
        tissue[z, y, x] -= bone.data
        bones[label] = resample_isotropic(bone, spacing_mm)
        mask = bone.with_data((labels.data[z, y, x] == label).to(torch.float32))
        masks[label] = resample_isotropic(mask, spacing_mm)
    points = torch.stack([landmarks[name] for name in HIP_LANDMARKS])
    coarse = resample_isotropic(ct.with_data(tissue), _TISSUE_MM)
    return Layers(_padded(coarse, (0, 0, _BEYOND), "replicate"), bones, masks, points)


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
    return Layers(
        _warped(layers.tissue, displacement),
        {label: _warped(_padded(bone, (8, 8, 8)), displacement) for label, bone in layers.bones.items()},
        {label: _warped(_padded(mask, (8, 8, 8)), displacement) for label, mask in layers.masks.items()},
        landmarks,
    )


def _warped(volume: Volume, displacement: Displacement) -> Volume:
    """The volume pulled back through the field, on its own grid."""
    depth, height, width = volume.data.shape
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in (depth, height, width)), indexing="ij")
    affine = volume.lps_from_index.float()
    points = torch.stack([x, y, z], -1) @ affine[:3, :3].T + affine[:3, 3]
    source = points + displacement(points)
    index_from_lps = torch.linalg.inv(affine)
    index = source @ index_from_lps[:3, :3].T + index_from_lps[:3, 3]
    size = torch.tensor([width, height, depth], dtype=torch.float32)
    unit = (2 * index + 1) / size - 1  # voxel centres at integers to grid_sample's −1 … 1 with align_corners=False
    data = F.grid_sample(volume.data[None, None], unit[None], align_corners=False)[0, 0]
    return volume.with_data(data)


def _padded(volume: Volume, margin_xyz: tuple[int, int, int], mode: str = "constant") -> Volume:
    """The volume with so many voxels more on both sides of each axis, zero or (`replicate`) as at its face."""
    x, y, z = margin_xyz
    affine = volume.lps_from_index.clone()
    affine[:3, 3] -= affine[:3, :3] @ torch.tensor(margin_xyz, dtype=torch.float64)
    return Volume(F.pad(volume.data[None, None], (x, x, y, y, z, z), mode=mode)[0, 0], affine)
