"""Glare, vignetting, shutter and saturation against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.geometry import centred_camera
from sim.physics.beam import shutter
from sim.physics.detector import veiling_glare, vignetting
from sim.physics.fluoroscopy import detect, fluoroscopy
from sim.theatre.settings import load_simulation

CAMERA = centred_camera(1000.0, (1.0, 1.0), (256, 256))


@pytest.fixture(scope="module")
def model():
    return load_simulation("paper").xray


def test_glare_keeps_the_light_of_a_point_in_the_middle() -> None:
    point = torch.zeros(256, 256)
    point[120:136, 120:136] = 1
    spread = veiling_glare(point, CAMERA, 0.2, 8.0)
    assert spread.sum().item() == pytest.approx(point.sum().item(), rel=1e-3)
    assert spread[128, 128].item() > 0.8


def test_glare_falls_off_as_its_kernel_does() -> None:
    """Far from a small bright spot: share · exp(−r / width) / (2π · width · r) of its light."""
    spot = torch.zeros(256, 256)
    spot[126:130, 126:130] = 100.0
    spread = veiling_glare(spot, CAMERA, 0.3, 16.0)
    for column in (150, 170, 190, 210):
        r = column - 127.5
        expected = 0.3 * 1600 * math.exp(-r / 16) / (2 * math.pi * 16 * r)
        assert spread[127:129, column].mean().item() == pytest.approx(expected, rel=0.06)


def test_glare_behind_a_lead_disc_follows_from_the_kernel() -> None:
    """In the middle of a disc of radius R there is share · (exp(−R / width) − exp(−edge / width)) of the light."""
    distance = CAMERA.pixel_positions()[..., :2].norm(dim=-1)
    for radius in (10, 25):
        light = ((distance > radius) & (distance < 120)).float()
        middle = veiling_glare(light, CAMERA, 0.2, 20.0)[127:129, 127:129].mean().item()
        assert middle == pytest.approx(0.2 * (math.exp(-radius / 20) - math.exp(-120 / 20)), rel=0.03)


def test_optics_lose_light_with_the_square_of_the_distance() -> None:
    share = vignetting(CAMERA, 0.2)
    distance = CAMERA.pixel_positions(torch.float32)[..., :2].norm(dim=-1)
    assert_close(share, 1 - 0.2 * (distance / 128) ** 2)


def test_a_shutter_is_open_within_its_turned_rectangle() -> None:
    share = shutter(CAMERA, 120.0, 60.0, 30.0)
    cos, sin = math.cos(math.radians(30)), math.sin(math.radians(30))
    for along, across, is_open in ((55, 0, 1), (65, 0, 0), (0, 25, 1), (0, 35, 0), (55, 25, 1), (-55, -35, 0)):
        column, row = 127.5 + along * cos - across * sin, 127.5 + along * sin + across * cos
        assert share[round(row), round(column)] == is_open
    assert share.sum().item() == pytest.approx(120 * 60, rel=5e-3)


def test_the_open_field_saturates_and_the_patient_does_not(model) -> None:
    water = torch.zeros(CAMERA.shape)
    water[:, 128:] = 15
    bright = replace(model, open_beam_counts=120_000.0)
    image = fluoroscopy({"water": water}, CAMERA, bright, torch.Generator().manual_seed(0)).float()
    assert (image[:, :100] == 65535).all()
    assert (image[:, 156:] < 30000).all()


def test_without_photons_counts_stop_at_zero(model) -> None:
    starved = replace(model, dose_ugy=0.05, gain_spread=0.0)
    image = detect(torch.zeros(CAMERA.shape), starved, CAMERA, torch.Generator().manual_seed(0)).float()
    assert image.max() > 100
    assert (image == 0).float().mean().item() == pytest.approx(0.5, abs=0.02)  # half of the electronic noise


def test_an_image_intensifier_is_off_in_the_presets(model) -> None:
    assert (model.glare, model.vignetting, model.shutter_width_mm) == (0, 0, 0)
    plain, shown = (
        detect(torch.full(CAMERA.shape, 0.1), chosen, CAMERA, torch.Generator().manual_seed(0)).float()
        for chosen in (model, replace(model, vignetting=0.2))
    )
    share = vignetting(CAMERA, 0.2)
    middle = slice(96, 160)
    assert (shown / plain)[middle, middle].mean().item() == pytest.approx(share[middle, middle].mean().item(), rel=5e-3)
