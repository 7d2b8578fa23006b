"""What X-rays pass through: mass attenuation coefficients, and densities from Hounsfield units.

Coefficients: Hubbell and Seltzer, Tables of X-ray mass attenuation coefficients, NIST Standard Reference Database 126
(water, cortical bone of ICRU-44, titanium, aluminium, dry air), interpolated log–log as the tables ask for.
"""

import torch
from torch import Tensor

from femoreg_torch.errors import InputError

_ENERGIES_KEV = (15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0)
_MASS_ATTENUATION = {  # total, with coherent scattering, cm²/g
    "water": (1.673, 0.8096, 0.3756, 0.2683, 0.2269, 0.2059, 0.1837, 0.1707),
    "bone": (9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229, 0.1855),
    "titanium": (35.87, 15.85, 4.972, 2.214, 1.213, 0.7661, 0.4052, 0.2721),
    "aluminium": (7.955, 3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704),
    "air, absorbed": (1.334, 0.5389, 0.1537, 0.06833, 0.04098, 0.03041, 0.02407, 0.02325),  # μ_en/ρ: energy absorption
}
LOWEST_KEV, HIGHEST_KEV = _ENERGIES_KEV[0], _ENERGIES_KEV[-1]  # of the tables
_BONE_DENSITY = 1.92  # g/cm³, cortical bone, ICRU Report 44
_SOFT_HU, _BONE_HU = 50.0, 1500.0  # muscle; the HU at which the density relation below gives cortical bone
_TOTAL_PER_HU = 0.0005886  # g/cm³, above water; see `tissue_densities`
# Between muscle and cortical bone each g of bone takes the place of so many g of soft tissue.
WATER_PER_BONE = 1 - _TOTAL_PER_HU * (_BONE_HU - _SOFT_HU) / _BONE_DENSITY
_REFERENCE_KEV = 60.0  # about the effective energy of a CT at 120 kVp


def mass_attenuation(material: str, energies_kev: Tensor) -> Tensor:
    """Coefficients in cm²/g of `water`, `bone`, `titanium` or `aluminium` at energies of 15 to 100 keV.

    Raises `InputError` for energies beyond the tables.
    """
    if energies_kev.min() < LOWEST_KEV or energies_kev.max() > HIGHEST_KEV:
        raise InputError(f"energies: {LOWEST_KEV:g} to {HIGHEST_KEV:g} keV are tabulated, got {energies_kev.tolist()}.")
    x = torch.tensor(_ENERGIES_KEV, dtype=torch.float64).log()
    y = torch.tensor(_MASS_ATTENUATION[material], dtype=torch.float64).log()
    query = energies_kev.to(torch.float64).log()
    upper = torch.searchsorted(x, query).clamp(1, len(x) - 1)
    weight = (query - x[upper - 1]) / (x[upper] - x[upper - 1])
    return torch.exp((1 - weight) * y[upper - 1] + weight * y[upper])


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
    energy = torch.tensor([_REFERENCE_KEV])
    water, titanium = (mass_attenuation(name, energy).item() for name in ("water", "titanium"))
    return (1 + hu / 1000) * water / titanium
