"""The spectrum of the X-ray tube, and how many photons a dose is."""

import math

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume.materials import HIGHEST_KEV, LOWEST_KEV, mass_attenuation

_ALUMINIUM_DENSITY = 2.699  # g/cm³


_K_EDGE_KEV = 69.525  # tungsten


# Kα1, Kα2, Kβ1, Kβ3, Kβ2 of tungsten, keV and relative intensity: X-ray Data Booklet, Lawrence Berkeley National
# Laboratory, LBNL/PUB-490 (2009), table 1-3; checked against xraylib 4.3.0.
_K_LINES = ((59.318, 100.0), (57.982, 58.0), (67.244, 22.0), (66.951, 11.0), (69.067, 8.0))


_KEV_PER_G_IN_UGY = 6.2415e6  # 1 Gy is 1 J/kg, 1 J is 6.2415e15 keV


def tungsten_spectrum(kvp: float, aluminium_mm: float, bins: int, k_lines: float) -> tuple[Tensor, Tensor]:
    """Energies in keV and the share of photons (sum 1): equal bins from 15 keV up to the tube voltage, then K lines.

    Thick-target bremsstrahlung by Kramers' law, N(E) ∝ (E₀ − E) / E (Kramers, Phil Mag 46 (1923) 836), and above the K
    edge of tungsten its characteristic lines, whose photons per electron grow as (E₀ / E_K − 1)^1.63 (after Green and
    Cosslett 1968, in International Tables for Crystallography C, 4.2.1.1.1); at twice the edge there are `k_lines` of
    them per photon of bremsstrahlung above 15 keV. All behind an aluminium filter. With 0.06 the lines' share is that
    of SpekPy 2.5.4 (anode of 10°, 4 mm of aluminium) within a sixth of it at 75 kV and a tenth from 80 to 100 kV.
    Raises `InputError` for a voltage beyond the tables of `femoreg_torch.volume.materials`.
    """
    if not LOWEST_KEV < kvp <= HIGHEST_KEV:
        raise InputError(f"kvp: a tube voltage between 15 and 100 kV was expected, got {kvp:g}.")
    width = (kvp - LOWEST_KEV) / bins
    energies = LOWEST_KEV + width * (torch.arange(bins, dtype=torch.float64) + 0.5)
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
    lowest = LOWEST_KEV
    return kvp * math.log(kvp / lowest) - (kvp - lowest)


def fluence(kerma_ugy: float, energies_kev: Tensor, photons: Tensor) -> float:
    """Photons per cm² of a spectrum (shares `photons`, sum 1) whose air kerma is `kerma_ugy`.

    K = Φ Σ share · E · μ_en/ρ (Attix, Introduction to Radiological Physics and Radiation Dosimetry, 1986, chapter 2).
    """
    per_photon = (photons * energies_kev * mass_attenuation("air, absorbed", energies_kev)).sum().item()
    return kerma_ugy * _KEV_PER_G_IN_UGY / per_photon
