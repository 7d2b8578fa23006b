"""The tube's spectrum against those of another model."""

import pytest
import torch
from torch.testing import assert_close

from sim.physics.spectrum import fluence, tungsten_spectrum

# SpekPy 2.5.4 (Poludniowski et al., Med Phys 48 (2021) 3630), anode of 10°, photons of 15 keV and more: tube voltage,
# aluminium in mm, mean energy, energy below which half of the photons lie (keV), photons per cm² and µGy of air kerma
_SPEKPY = [
    (60.0, 3.0, 36.93, 36.05, 1.628e6),
    (75.0, 4.0, 43.79, 42.44, 2.068e6),
    (90.0, 4.0, 49.00, 47.37, 2.291e6),
    (100.0, 5.0, 53.36, 52.10, 2.517e6),
]


@pytest.mark.parametrize(("kvp", "aluminium_mm", "mean", "median", "per_ugy"), _SPEKPY)
def test_the_spectrum_is_that_of_another_model(kvp, aluminium_mm, mean, median, per_ugy):
    """Kramers' law has no filtration by the anode, so it is softer: some 4 % in energy, 10 % in photons per dose."""
    energies, photons = tungsten_spectrum(kvp, aluminium_mm, 200, 0.06)
    order = energies.argsort()
    middle = energies[order][torch.searchsorted(photons[order].cumsum(0), 0.5)]
    assert (energies * photons).sum().item() == pytest.approx(mean, rel=0.05)
    assert middle.item() == pytest.approx(median, rel=0.06)
    assert fluence(1.0, energies, photons) == pytest.approx(per_ugy, rel=0.12)


def test_a_thicker_filter_hardens_the_beam():
    means = []
    for millimetres in (2.5, 5.0):
        energies, photons = tungsten_spectrum(75, millimetres, 12, 0.0)
        assert photons.sum().item() == pytest.approx(1)
        means.append((energies * photons).sum().item())
    assert 38 < means[0] < means[1] < 55


def test_k_lines_come_with_the_edge_and_keep_their_place():
    below, above = (tungsten_spectrum(kvp, 4.0, 8, 0.06) for kvp in (69.0, 80.0))
    assert len(below[0]) == 8
    energies, photons = above
    assert energies[8:].tolist() == [59.318, 57.982, 67.244, 66.951, 69.067]
    assert photons.sum().item() == pytest.approx(1)
    assert 0.005 < photons[8:].sum().item() < 0.05
    without = tungsten_spectrum(80.0, 4.0, 8, 0.0)[1]
    assert_close(photons[:8] / photons[0], without / without[0])


@pytest.mark.parametrize(("kvp", "share"), [(75.0, 0.0072), (80.0, 0.0184), (90.0, 0.0416), (100.0, 0.0615)])
def test_share_of_the_k_lines_is_that_of_another_model(kvp, share):
    """Shares by SpekPy 2.5.4: anode of 10°, 4 mm of aluminium."""
    photons = tungsten_spectrum(kvp, 4.0, 40, 0.06)[1]
    assert photons[40:].sum().item() == pytest.approx(share, rel=0.17)


def test_dose_of_one_line_is_its_energy_absorbed_in_air():
    """At 60 keV 1 µGy is 6.2415e6 keV/g over 60 keV · 0.03041 cm²/g: 3.42e6 photons/cm²."""
    line = fluence(1.0, torch.tensor([60.0]), torch.tensor([1.0]))
    assert line == pytest.approx(6.2415e6 / (60 * 0.03041), rel=1e-5)
