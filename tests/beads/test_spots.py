"""Shadows of beads: found among clutter, and measured to a fraction of a pixel."""

import numpy as np
import pytest
import torch
from bead_scenes import disc_image
from scipy import integrate, ndimage

from femoreg_torch.beads import find_spots
from femoreg_torch.beads.spots import blur_on, shadow
from femoreg_torch.errors import InputError

CENTRES = torch.tensor([[60.3, 70.8], [130.0, 55.5], [221.7, 172.2], [90.45, 190.1], [250.6, 215.9]]).double()


def test_profile_is_that_of_a_blurred_sphere() -> None:
    rows, columns = np.mgrid[-200:201, -200:201] / 10.0  # tenths of a pixel
    sharp = np.sqrt(np.clip(1 - (rows**2 + columns**2) / 3.5**2, 0, None))
    blurred = ndimage.gaussian_filter(sharp, 9.0)
    distances = np.arange(0, 6, 0.5)
    np.testing.assert_allclose(shadow(3.5, distances, 0.9), blurred[200, 200 + (distances * 10).astype(int)], atol=2e-3)
    fine = np.linspace(0, 9, 1801)
    whole = integrate.simpson(2 * np.pi * fine * shadow(3.5, fine, 0.9), x=fine)
    assert whole == pytest.approx(2 / 3 * np.pi * 3.5**2, rel=2e-3)  # half the volume of a sphere of height 1


@pytest.mark.parametrize(("radius_px", "noise"), [(3.5, 0.02), (3.5, 0.06), (7.0, 0.06)])
def test_centres_are_found_to_a_fraction_of_a_pixel(radius_px: float, noise: float) -> None:
    image = disc_image(CENTRES, radius_px, (280, 300), 0.6, noise, seed=1)
    spots = find_spots(image, radius_px)
    nearest = torch.cdist(CENTRES, spots.pixels).min(1)
    assert nearest.values.max() < 0.35
    assert len(spots) == len(CENTRES)  # neither bone edges nor the bar
    assert (spots.radii_px[nearest.indices] - radius_px).abs().max() < 0.12 * radius_px
    assert (spots.contrasts[nearest.indices] - 0.6).abs().max() < 0.12


def test_on_the_flank_of_a_rim_as_narrow_as_a_bead_a_pixel_is_lost_at_most() -> None:
    """A ridge of half the contrast pulls the centre along: the bundle's outlier test is for such shadows."""
    flank = torch.tensor([[221.7, 140.2]]).double()
    spots = find_spots(disc_image(flank, 3.5, (280, 300), 0.6, 0.03, seed=6), 3.5)
    assert torch.cdist(flank, spots.pixels).min() < 1.0


def test_a_shift_of_the_image_shifts_the_centres() -> None:
    image = disc_image(CENTRES, 3.5, (280, 300), 0.6, 0.03, seed=2)
    first, second = (find_spots(part, 3.5).pixels for part in (image, image[7:, 5:]))
    moved = second + torch.tensor([5.0, 7.0])
    assert torch.cdist(first, moved).min(1).values.max() < 0.02


def test_what_is_not_exposed_is_not_searched() -> None:
    field = torch.ones(280, 300, dtype=torch.bool)
    field[:, 200:] = False
    spots = find_spots(disc_image(CENTRES, 3.5, (280, 300), 0.6, 0.02, seed=3), 3.5, field)
    assert len(spots) == 3
    assert (spots.pixels[:, 0] < 200).all()


def test_beads_of_another_size_are_none() -> None:
    image = disc_image(CENTRES, 3.5, (280, 300), 0.6, 0.02, seed=4)
    assert len(find_spots(image, 10.0)) == 0


def test_an_image_without_beads_has_none() -> None:
    assert len(find_spots(disc_image(CENTRES[:0], 3.5, (280, 300), 0.6, 0.05, seed=5), 3.5)) == 0


@pytest.mark.parametrize("radius_px", [0.0035, 3500.0, float("nan")])
def test_wrong_units_are_told_in_one_line(radius_px: float) -> None:
    with pytest.raises(InputError, match="in mm") as caught:
        find_spots(torch.zeros(50, 50), radius_px)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("pixel_mm", [0.1, 0.194, 0.3, 0.388])
def test_a_bead_behind_one_scintillator_is_found_on_pixels_of_any_size(pixel_mm: float) -> None:
    """A shadow of 0.8 mm radius, drawn six times as fine as the pixels and blurred by 0.15 mm, in noise of 1 %."""
    count, parts, radius_mm = 60, 6, 0.8
    line = (np.arange(count * parts) + 0.5) / parts - 0.5
    apart = np.hypot(*np.meshgrid(line - 30.3, line - 28.6)) * pixel_mm / radius_mm
    fine = ndimage.gaussian_filter(np.sqrt(np.clip(1 - apart**2, 0, None)), 0.15 / pixel_mm * parts)
    image = 0.8 * fine.reshape(count, parts, count, parts).mean((1, 3))
    image += np.random.default_rng(2).normal(0, 0.01, image.shape)
    found = find_spots(torch.from_numpy(image), radius_mm / pixel_mm, None, blur_on(pixel_mm))
    np.testing.assert_allclose(found.pixels[:1].numpy(), [[30.3, 28.6]], atol=0.05)
    assert float(found.radii_px[0]) * pixel_mm == pytest.approx(radius_mm, rel=0.05)
