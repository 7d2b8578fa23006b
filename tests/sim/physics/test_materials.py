"""Attenuation coefficients and densities against tables that the module does not hold."""

import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from sim.physics.materials import mass_attenuation, metal_density, tissue_densities

# cm²/g, total with coherent scattering, half-way between the energies of the module's tables: xraylib 4.3.0 (Schoonjans
# et al., Spectrochim Acta B 66 (2011) 776), by mass fractions of the elements (bone: cortical bone of ICRU Report 44)
_KEV = (25.0, 35.0, 45.0, 55.0, 70.0, 90.0)
_XRAYLIB = {
    "water": (0.50824, 0.30747, 0.24362, 0.21494, 0.19285, 0.17655),
    "bone": (2.15818, 0.90610, 0.51891, 0.36006, 0.25705, 0.20083),
    "titanium": (8.37117, 3.21162, 1.60478, 0.94994, 0.53612, 0.32470),
    "aluminium": (1.83565, 0.76962, 0.44656, 0.31514, 0.23011, 0.18333),
}


@pytest.mark.parametrize("material", _XRAYLIB)
def test_coefficients_between_the_tabulated_energies_are_those_of_another_library(material):
    """Log–log interpolation over steps of 10 to 20 keV lies at most 4.4 % above (water at 25 keV)."""
    found = mass_attenuation(material, torch.tensor(_KEV, dtype=torch.float64))
    assert_close(found, torch.tensor(_XRAYLIB[material], dtype=torch.float64), rtol=0.05, atol=0)


@pytest.mark.parametrize(
    ("material", "kev", "expected"), [("water", 60, 0.2059), ("bone", 40, 0.6655), ("aluminium", 80, 0.2018)]
)
def test_coefficients_are_those_of_the_tables(material, kev, expected):
    assert mass_attenuation(material, torch.tensor([float(kev)])).item() == pytest.approx(expected, rel=1e-6)


def test_coefficients_between_the_tabulated_energies_lie_on_the_log_log_line():
    middle = mass_attenuation("bone", torch.tensor([(40.0 * 50.0) ** 0.5], dtype=torch.float64)).item()
    assert middle == pytest.approx((0.6655 * 0.4242) ** 0.5, rel=1e-6)


def test_energies_outside_the_tables_are_refused():
    with pytest.raises(InputError, match="keV"):
        mass_attenuation("water", torch.tensor([10.0]))


def test_densities_of_air_water_and_cortical_bone():
    soft, bone = tissue_densities(torch.tensor([-1024.0, 0.0, 775.0, 1500.0]))
    assert_close(soft + bone, torch.tensor([0.0, 1.03, 1.486165, 1.9129]), atol=1e-4, rtol=0)
    assert bone[:2].tolist() == [0, 0]
    assert bone[2].item() == pytest.approx(0.96, abs=1e-3)  # half-way from muscle to cortical bone, half of 1.92
    assert soft[3].item() == pytest.approx(0, abs=1e-6)


def test_metal_attenuates_as_its_hounsfield_units_say():
    at_60 = torch.tensor([60.0])
    titanium = metal_density(5000) * mass_attenuation("titanium", at_60).item()
    assert titanium == pytest.approx(6 * mass_attenuation("water", at_60).item())
