"""What X-rays meet: mass attenuation coefficients, densities from Hounsfield units, and the spectrum of the tube.

Coefficients: Hubbell and Seltzer, Tables of X-ray mass attenuation coefficients, NIST Standard Reference Database 126
(water, cortical bone of ICRU-44, titanium, aluminium, dry air), interpolated log–log as the tables ask for.
"""

import math

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
_BONE_DENSITY = 1.92  # g/cm³, cortical bone, ICRU Report 44
_ALUMINIUM_DENSITY = 2.699  # g/cm³
_K_EDGE_KEV = 69.525  # tungsten
# Kα1, Kα2, Kβ1, Kβ3, Kβ2 of tungsten, keV and relative intensity: X-ray Data Booklet, Lawrence Berkeley National
# Laboratory, LBNL/PUB-490 (2009), table 1-3; checked against xraylib 4.3.0.
_K_LINES = ((59.318, 100.0), (57.982, 58.0), (67.244, 22.0), (66.951, 11.0), (69.067, 8.0))
_KEV_PER_G_IN_UGY = 6.2415e6  # 1 Gy is 1 J/kg, 1 J is 6.2415e15 keV
_SOFT_HU, _BONE_HU = 50.0, 1500.0  # muscle; the HU at which the density relation below gives cortical bone
_TOTAL_PER_HU = 0.0005886  # g/cm³, above water; see `tissue_densities`
# Between muscle and cortical bone each g of bone takes the place of so many g of soft tissue.
WATER_PER_BONE = 1 - _TOTAL_PER_HU * (_BONE_HU - _SOFT_HU) / _BONE_DENSITY
_REFERENCE_KEV = 60.0  # about the effective energy of a CT at 120 kVp


def mass_attenuation(material: str, energies_kev: Tensor) -> Tensor:
    """Coefficients in cm²/g of `water`, `bone`, `titanium` or `aluminium` at energies of 15 to 100 keV."""
    lowest, highest = _ENERGIES_KEV[0], _ENERGIES_KEV[-1]
    if energies_kev.min() < lowest or energies_kev.max() > highest:
        raise InputError(f"energies: {lowest:g} to {highest:g} keV are tabulated, got {energies_kev.tolist()}.")
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


def tungsten_spectrum(kvp: float, aluminium_mm: float, bins: int, k_lines: float) -> tuple[Tensor, Tensor]:
    """Energies in keV and the share of photons (sum 1): equal bins from 15 keV up to the tube voltage, then K lines.

    Thick-target bremsstrahlung by Kramers' law, N(E) ∝ (E₀ − E) / E (Kramers, Phil Mag 46 (1923) 836), and above the K
    edge of tungsten its characteristic lines, whose photons per electron grow as (E₀ / E_K − 1)^1.63 (after Green and
    Cosslett 1968, in International Tables for Crystallography C, 4.2.1.1.1); at twice the edge there are `k_lines` of
    them per photon of bremsstrahlung above 15 keV. All behind an aluminium filter. With 0.06 the lines' share is that
    of SpekPy 2.5.4 (anode of 10°, 4 mm of aluminium) within a sixth of it at 75 kV and a tenth from 80 to 100 kV.
    """
    if not _ENERGIES_KEV[0] < kvp <= _ENERGIES_KEV[-1]:
        raise InputError(f"kvp: a tube voltage between 15 and 100 kV was expected, got {kvp:g}.")
    width = (kvp - _ENERGIES_KEV[0]) / bins
    energies = _ENERGIES_KEV[0] + width * (torch.arange(bins, dtype=torch.float64) + 0.5)
    photons = (kvp - energies) / energies
    if kvp > _K_EDGE_KEV and k_lines > 0:
        lines, intensity = torch.tensor(_K_LINES, dtype=torch.float64).T
        excited = k_lines * (kvp / _K_EDGE_KEV - 1) ** 1.63 * _bremsstrahlung(2 * _K_EDGE_KEV) / width
        energies = torch.cat([energies, lines])
        photons = torch.cat([photons, excited * intensity / intensity.sum()])
    photons = photons * torch.exp(-mass_attenuation("aluminium", energies) * _ALUMINIUM_DENSITY * aluminium_mm / 10)
    return energies, photons / photons.sum()


def _bremsstrahlung(kvp: float) -> float:
    """Integral of Kramers' (E₀ − E) / E from 15 keV to the tube voltage, in keV."""
    lowest = _ENERGIES_KEV[0]
    return kvp * math.log(kvp / lowest) - (kvp - lowest)


def fluence(kerma_ugy: float, energies_kev: Tensor, photons: Tensor) -> float:
    """Photons per cm² of a spectrum (shares `photons`, sum 1) whose air kerma is `kerma_ugy`.

    K = Φ Σ share · E · μ_en/ρ (Attix, Introduction to Radiological Physics and Radiation Dosimetry, 1986, chapter 2).
    """
    per_photon = (photons * energies_kev * mass_attenuation("air, absorbed", energies_kev)).sum().item()
    return kerma_ugy * _KEV_PER_G_IN_UGY / per_photon
