"""Densities that Hounsfield units stand for."""

import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.volume.materials import mass_attenuation
from sim.physics.materials import metal_density, tissue_densities


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
