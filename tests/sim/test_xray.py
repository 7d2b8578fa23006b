"""Physics of the simulated images against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, rigid
from femoreg_torch.volume import Volume, axis_aligned
from sim.acquisition import load_settings
from sim.materials import mass_attenuation, metal_density, tissue_densities, tungsten_spectrum
from sim.xray import areal_densities, blur, detect, fluoroscopy, scattered, transmission

CAMERA = centred_camera(1000.0, (2.0, 2.0), (64, 64))


@pytest.fixture(scope="module")
def model():
    return load_settings("paper")[1]


def noiseless(model):
    return replace(model, blur_sigma_px=0.0, electronic_noise=0.0, scatter=0.0)


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


def test_a_thicker_filter_hardens_the_beam():
    means = []
    for millimetres in (2.5, 5.0):
        energies, photons = tungsten_spectrum(75, millimetres, 12)
        assert photons.sum().item() == pytest.approx(1)
        means.append((energies * photons).sum().item())
    assert 38 < means[0] < means[1] < 55


def test_a_slab_of_bone_follows_beer_lambert_at_every_energy(model):
    """A slab that faces the source: mass per area is thickness over the slant of the ray, times density."""
    slab = Volume(torch.full((8, 100, 100), 1.92), axis_aligned((4.0, 4.0, 4.0), (-198.0, -198.0, -14.0)))
    pose = rigid(translation=torch.tensor([0.0, 0.0, 500.0], dtype=torch.float64))
    areal = areal_densities({"bone": slab}, pose, CAMERA, 0.25)
    rays = CAMERA.pixel_positions()
    slant = rays.norm(dim=-1) / CAMERA.sdd_mm
    assert_close(areal["bone"], (3.2 * 1.92 * slant).float(), rtol=2e-3, atol=0)

    energies, photons = tungsten_spectrum(model.kvp, model.aluminium_mm, model.energy_bins)
    expected = np.zeros(areal["bone"].shape)
    for energy, share in zip(energies.tolist(), photons.tolist(), strict=True):
        mu = np.exp(
            np.interp(
                np.log(energy),
                np.log([15, 20, 30, 40, 50, 60, 80]),
                np.log([9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229]),
            )
        )
        expected += share * energy * np.exp(-mu * areal["bone"].double().numpy())
    expected /= (energies * photons).sum().item()
    assert_close(transmission(areal, model), torch.from_numpy(expected).float(), rtol=1e-4, atol=0)


def test_beam_hardening_makes_the_second_slab_cheaper(model):
    once, twice = (transmission({"bone": torch.full((1, 1), mass)}, model).item() for mass in (3.0, 6.0))
    assert twice > 1.2 * once**2


def test_open_beam_has_no_scatter_and_full_counts(model):
    nothing = {"water": torch.zeros(CAMERA.shape)}
    assert scattered(transmission(nothing, model), model, CAMERA).abs().max() < 1e-6
    image = fluoroscopy(nothing, CAMERA, model, torch.Generator().manual_seed(0))
    assert image.float().mean().item() == pytest.approx(model.open_beam_counts, rel=1e-3)


def test_scatter_is_smooth_and_adds_to_the_dark_parts(model):
    areal = torch.full(CAMERA.shape, 15.0)
    areal[:, 32:] += 5
    field = scattered(transmission({"water": areal}, model), model, CAMERA)
    assert (field > 0).all()
    step = (field[:, 1:] - field[:, :-1]).abs().max() / field.mean()
    assert step < 0.1


def test_quantum_noise_has_the_mean_and_variance_of_poisson_plus_electronics(model):
    model = replace(noiseless(model), photons=10_000.0, electronic_noise=20.0, open_beam_counts=10_000.0)
    image = detect(torch.full((400, 400), 0.09), model, torch.Generator().manual_seed(3)).float()
    assert image.mean().item() == pytest.approx(900, abs=0.5)
    assert image.var().item() == pytest.approx(900 + 400 + 1 / 12, rel=0.02)


def test_blur_keeps_the_mean_and_spreads_a_point_by_its_sigma():
    image = torch.zeros(41, 41)
    image[20, 20] = 1
    spread = blur(image, 1.5)
    assert spread.sum().item() == pytest.approx(1, abs=1e-5)
    columns = torch.arange(41) - 20.0
    assert (spread.sum(0) * columns**2).sum().item() == pytest.approx(1.5**2, rel=0.02)
    assert torch.equal(blur(image, 0.0), image)


def test_the_same_seed_gives_the_same_bits(model):
    areal = {"water": torch.full((32, 32), 18.0)}
    first, again, other = (fluoroscopy(areal, CAMERA, model, torch.Generator().manual_seed(s)) for s in (5, 5, 6))
    assert first.dtype == torch.uint16
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_bone_is_dark(model):
    areal = {"water": torch.full((16, 16), 15.0), "bone": torch.zeros(16, 16)}
    areal["bone"][:, 8:] = 2
    image = fluoroscopy(areal, centred_camera(1000.0, (2.0, 2.0), (16, 16)), model, torch.Generator().manual_seed(0))
    assert image[:, 8:].float().mean() < 0.8 * image[:, :8].float().mean()


@pytest.mark.parametrize("change", ["unknown: 1", "kvp"])
def test_settings_that_do_not_fit_are_named(tmp_path, change):
    from importlib.resources import files

    text = files("femoreg_torch.configs").joinpath("simulation", "paper.yaml").read_text(encoding="utf-8")
    text = text.replace("  kvp: 75\n", "" if change == "kvp" else f"  kvp: 75\n  {change}\n")
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=change.split(":")[0]):
        load_settings(str(tmp_path / "mine.yaml"))
