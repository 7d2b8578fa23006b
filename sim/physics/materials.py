"""Densities of tissues and of metal from Hounsfield units."""

import torch
from torch import Tensor

from femoreg_torch.volume.materials import relative_to_water

_BONE_DENSITY = 1.92  # g/cm³, cortical bone, ICRU Report 44
_SOFT_HU, _BONE_HU = 50.0, 1500.0  # muscle; the HU at which the density relation below gives cortical bone
_TOTAL_PER_HU = 0.0005886  # g/cm³, above water; see `tissue_densities`
# Between muscle and cortical bone each g of bone takes the place of so many g of soft tissue.
WATER_PER_BONE = 1 - _TOTAL_PER_HU * (_BONE_HU - _SOFT_HU) / _BONE_DENSITY


def tissue_densities(hu: Tensor) -> tuple[Tensor, Tensor]:
    """Mass densities in g/cm³ of (water-like soft tissue, cortical bone) that together make up voxels of these HU.

    Total density: ρ = 1.03 + 0.001029 HU below water and 1.03 + 0.0005886 HU above (`conv_hu_to_density` of DeepDRR,
    Unberath et al., MICCAI 2018; within 1 % that of Schneider et al., Phys Med Biol 45 (2000) 459). Between muscle and
    cortical bone a voxel is a mixture by volume, so the split is linear in HU and a voxel at the rim of a bone is
    neither one nor the other.
    """
    total = torch.minimum(1.03 + 0.001029 * hu, 1.03 + _TOTAL_PER_HU * hu).clamp_min(0)
    share = ((hu - _SOFT_HU) / (_BONE_HU - _SOFT_HU)).clamp_min(0)
    bone = torch.minimum(share * _BONE_DENSITY, total)
    return total - bone, bone


def metal_density(hu: float) -> float:
    """Density in g/cm³ of titanium that a CT would show at this HU, by its attenuation at 60 keV."""
    return (1 + hu / 1000) / relative_to_water("titanium")
