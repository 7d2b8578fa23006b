"""How strongly materials of devices, and of patients, attenuate X-rays.

Coefficients: Hubbell and Seltzer, Tables of X-ray mass attenuation coefficients, NIST Standard Reference Database 126
(water, cortical bone of ICRU-44, elements, dry air), interpolated log–log as the tables ask for. Alloys and polymers
are mixtures by mass of their elements, from xraylib 4.3.0 (Schoonjans et al., Spectrochim Acta B 66 (2011) 776), which
agrees with the tables within 0.3 % where both have a material.
"""

import torch
from torch import Tensor

from femoreg_torch.errors import InputError, shortened

_ENERGIES_KEV = (15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0)
_MASS_ATTENUATION = {  # total, with coherent scattering, cm²/g
    "water": (1.673, 0.8096, 0.3756, 0.2683, 0.2269, 0.2059, 0.1837, 0.1707),
    "bone": (9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229, 0.1855),
    "titanium": (35.87, 15.85, 4.972, 2.214, 1.213, 0.7661, 0.4052, 0.2721),
    "aluminium": (7.955, 3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704),
    # with molybdenum, whose K edge at 20.0 keV is taken as lying below that energy
    "steel": (55.48, 26.45, 8.551, 3.808, 2.057, 1.266, 0.6228, 0.3865),  # AISI 316L: Fe 65.5 Cr 17 Ni 12 Mo 2.5 Mn 2
    "cobalt chromium": (55.36, 28.75, 9.392, 4.197, 2.269, 1.392, 0.6778, 0.4148),  # ASTM F75: Co 64 Cr 29 Mo 6 Ni 1
    "pmma": (1.101, 0.5714, 0.3032, 0.2350, 0.2074, 0.1924, 0.1751, 0.1641),
    "peek": (0.9605, 0.5094, 0.2807, 0.2219, 0.1977, 0.1842, 0.1684, 0.1580),
    "air, absorbed": (1.334, 0.5389, 0.1537, 0.06833, 0.04098, 0.03041, 0.02407, 0.02325),  # μ_en/ρ: energy absorption
}
LOWEST_KEV, HIGHEST_KEV = _ENERGIES_KEV[0], _ENERGIES_KEV[-1]  # of the tables
_REFERENCE_KEV = 60.0  # about the effective energy of a CT at 120 kVp
DENSITIES = {  # g/cm³, of what devices are made of
    "steel": 7.95,
    "cobalt chromium": 8.30,
    "titanium": 4.45,
    "aluminium": 2.70,
    "peek": 1.30,
    "pmma": 1.19,
}


def mass_attenuation(material: str, energies_kev: Tensor) -> Tensor:
    """Coefficients in cm²/g, of the shape of the energies, at 15 to 100 keV.

    Raises `InputError` for a material or an energy that is not in the tables.
    """
    if material not in _MASS_ATTENUATION:
        raise InputError(
            f"material: {shortened(material)} is not in the tables; there are: {', '.join(_MASS_ATTENUATION)}."
        )
    if energies_kev.min() < LOWEST_KEV or energies_kev.max() > HIGHEST_KEV:
        raise InputError(f"energies: {LOWEST_KEV:g} to {HIGHEST_KEV:g} keV are tabulated, got {energies_kev.tolist()}.")
    x = torch.tensor(_ENERGIES_KEV, dtype=torch.float64).log()
    y = torch.tensor(_MASS_ATTENUATION[material], dtype=torch.float64).log()
    query = energies_kev.to(torch.float64).log()
    upper = torch.searchsorted(x, query).clamp(1, len(x) - 1)
    weight = (query - x[upper - 1]) / (x[upper] - x[upper - 1])
    return torch.exp((1 - weight) * y[upper - 1] + weight * y[upper])


def material_hu(material: str) -> float:
    """HU that a CT would show of a solid material of a device, by its attenuation at 60 keV. Raises `InputError`."""
    if material not in DENSITIES:
        raise InputError(
            f"material: {shortened(material)} is unknown; there are: {', '.join(DENSITIES)}. Or give its `hu`."
        )
    return 1000 * (DENSITIES[material] * relative_to_water(material) - 1)


def relative_to_water(material: str) -> float:
    """Mass attenuation of a material per that of water, at 60 keV."""
    energy = torch.tensor([_REFERENCE_KEV])
    return float(mass_attenuation(material, energy) / mass_attenuation("water", energy))
