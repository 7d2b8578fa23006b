"""Physics of the simulated images against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch.testing import assert_close

from femoreg_torch.geometry import centred_camera, rigid
from femoreg_torch.volume import Volume, axis_aligned
from sim.physics.beam import circular_collimator, heel, inverse_square, open_beam
from sim.physics.detector import blur, gain_pattern, motion_blur
from sim.physics.fluoroscopy import detect, fluoroscopy, photons_per_pixel, scattered, transmission
from sim.physics.line_integrals import areal_densities
from sim.physics.spectrum import tungsten_spectrum
from sim.theatre.settings import load_simulation

CAMERA = centred_camera(1000.0, (2.0, 2.0), (64, 64))
FLAT = torch.ones(CAMERA.shape)  # a beam that does not fall off


@pytest.fixture(scope="module")
def model():
    return load_simulation("paper").xray


def noiseless(model):
    return replace(model, blur_sigma_mm=0.0, electronic_noise=0.0, scatter=0.0, gain_spread=0.0)


def test_a_slab_of_bone_follows_beer_lambert_at_every_energy(model):
    """A slab that faces the source: mass per area is thickness over the slant of the ray, times density."""
    slab = Volume(torch.full((8, 100, 100), 1.92), axis_aligned((4.0, 4.0, 4.0), (-198.0, -198.0, -14.0)))
    pose = rigid(translation=torch.tensor([0.0, 0.0, 500.0], dtype=torch.float64))
    areal = areal_densities({"bone": slab}, pose, CAMERA, 0.25)
    rays = CAMERA.pixel_positions()
    slant = rays.norm(dim=-1) / CAMERA.sdd_mm
    assert_close(areal["bone"], (3.2 * 1.92 * slant).float(), rtol=2e-3, atol=0)

    energies, photons = tungsten_spectrum(model.kvp, model.aluminium_mm, model.energy_bins, model.k_lines)
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
    assert scattered(transmission(nothing, model), model, CAMERA, FLAT).abs().max() < 1e-6
    plain = replace(model, inverse_square=False, heel=0.0)
    image = fluoroscopy(nothing, CAMERA, plain, torch.Generator().manual_seed(0))
    assert image.float().mean().item() == pytest.approx(model.open_beam_counts, rel=1e-3)


def test_scatter_is_smooth_and_adds_to_the_dark_parts(model):
    areal = torch.full(CAMERA.shape, 15.0)
    areal[:, 32:] += 5
    field = scattered(transmission({"water": areal}, model), model, CAMERA, FLAT)
    assert (field > 0).all()
    step = (field[:, 1:] - field[:, :-1]).abs().max() / field.mean()
    assert step < 0.1


def test_the_beam_falls_off_with_the_cube_of_the_cosine_and_towards_the_anode():
    camera = centred_camera(100.0, (1.0, 1.0), (201, 201))
    assert inverse_square(camera)[100, 100].item() == pytest.approx(1)
    assert inverse_square(camera)[100, 200].item() == pytest.approx(0.5**1.5)  # 45°
    tilt = heel(camera, 0.1)[0]
    assert tilt[100].item() == pytest.approx(1)
    assert (tilt[200] - tilt[0]).item() == pytest.approx(0.1 * 200 / 201)


def test_a_collimator_is_open_within_its_radius():
    share = circular_collimator(CAMERA, 40.0)
    distance = CAMERA.pixel_positions()[..., :2].norm(dim=-1)
    assert (share[distance < 38.9] == 1).all()
    assert (share[distance > 41.1] == 0).all()
    assert torch.equal(open_beam(CAMERA, False, 0.0, 0.0), FLAT)
    assert torch.equal(open_beam(CAMERA, False, 0.0, 40.0), share)


def test_behind_the_collimator_there_is_only_scatter(model):
    water = {"water": torch.full(CAMERA.shape, 15.0)}
    closed = replace(model, collimator_mm=40.0)
    image = fluoroscopy(water, CAMERA, closed, torch.Generator().manual_seed(0)).float()
    dark = fluoroscopy(water, CAMERA, replace(closed, scatter=0.0), torch.Generator().manual_seed(0)).float()
    beyond = (32, 32 + 24)  # 49 mm from the middle
    assert dark[beyond] < 20
    assert 40 < image[beyond] < 0.5 * image[32, 32]


def test_quantum_noise_has_the_mean_and_variance_of_poisson_plus_electronics(model):
    camera = centred_camera(1000.0, (2.0, 2.0), (400, 400))
    model = replace(noiseless(model), dose_ugy=1.0, electronic_noise=10.0, open_beam_counts=10_000.0)
    model = replace(model, dose_ugy=10_000.0 / photons_per_pixel(model, camera))
    assert photons_per_pixel(model, camera) == pytest.approx(10_000)
    image = detect(torch.full((400, 400), 0.09), model, camera, torch.Generator().manual_seed(3)).float()
    assert image.mean().item() == pytest.approx(900, abs=0.5)
    assert image.var().item() == pytest.approx(900 + (10 * 2) ** 2 + 1 / 12, rel=0.02)


def test_gain_is_a_fixed_pattern_of_its_spread(model):
    pattern = gain_pattern((400, 300), 0.02)
    assert pattern.mean().item() == pytest.approx(1, abs=1e-3)
    assert pattern.std().item() == pytest.approx(0.02, rel=0.1)
    assert torch.equal(pattern, gain_pattern((400, 300), 0.02))
    many = replace(noiseless(model), dose_ugy=1e6, gain_spread=0.02, open_beam_counts=30_000.0)
    camera = centred_camera(1000.0, (2.0, 2.0), (400, 300))
    image = detect(torch.ones(400, 300), many, camera, torch.Generator().manual_seed(0)).float()
    assert_close(image / 30_000, pattern, atol=2e-3, rtol=0)


def test_motion_smears_along_its_line_and_keeps_the_middle():
    image = torch.zeros(61, 61)
    image[30, 30] = 1
    smeared = motion_blur(image, 12.0, math.radians(30))
    assert smeared.sum().item() == pytest.approx(1, abs=1e-5)
    row, column = torch.meshgrid(torch.arange(61.0) - 30, torch.arange(61.0) - 30, indexing="ij")
    assert (smeared * row).sum().item() == pytest.approx(0, abs=1e-3)
    assert (smeared * column).sum().item() == pytest.approx(0, abs=1e-3)
    along = column * math.cos(math.radians(30)) + row * math.sin(math.radians(30))
    assert (smeared * along**2).sum().item() == pytest.approx(12.0**2 / 12, rel=0.1)  # of a uniform line
    across = row * math.cos(math.radians(30)) - column * math.sin(math.radians(30))
    assert (smeared * across**2).sum().item() < 0.5


def test_motion_is_drawn_from_the_seed(model):
    moving = replace(model, motion_mm=20.0)
    areal = {"water": torch.zeros(CAMERA.shape)}
    areal["water"][:, 32:] = 20
    first, again, other = (fluoroscopy(areal, CAMERA, moving, torch.Generator().manual_seed(s)) for s in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_blur_keeps_the_mean_and_spreads_a_point_by_its_sigma():
    image = torch.zeros(41, 41)
    image[20, 20] = 1
    spread = blur(image, 1.5)
    assert spread.sum().item() == pytest.approx(1, abs=1e-5)
    columns = torch.arange(41) - 20.0
    assert (spread.sum(0) * columns**2).sum().item() == pytest.approx(1.5**2, rel=0.02)
    assert torch.equal(blur(image, 0.0), image)


def test_the_same_seed_gives_the_same_bits(model):
    areal = {"water": torch.full(CAMERA.shape, 18.0)}
    first, again, other = (fluoroscopy(areal, CAMERA, model, torch.Generator().manual_seed(s)) for s in (5, 5, 6))
    assert first.dtype == torch.uint16
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_bone_is_dark(model):
    areal = {"water": torch.full((16, 16), 15.0), "bone": torch.zeros(16, 16)}
    areal["bone"][:, 8:] = 2
    image = fluoroscopy(areal, centred_camera(1000.0, (2.0, 2.0), (16, 16)), model, torch.Generator().manual_seed(0))
    assert image[:, 8:].float().mean() < 0.8 * image[:, :8].float().mean()


@pytest.mark.parametrize("sigma_px", [0.4, 0.8, 3.0])
def test_the_blur_is_the_gaussian_filter_of_scipy(sigma_px):
    image = 1e4 * torch.rand(37, 52, generator=torch.Generator().manual_seed(0))
    expected = ndimage.gaussian_filter(image.numpy(), sigma_px)
    assert np.abs(blur(image, sigma_px).numpy() - expected).max() < 1e-2
