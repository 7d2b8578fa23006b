"""Distortion of an image intensifier, against one that is known."""

import numpy as np
import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import find_distortion, find_grid_spots
from femoreg_torch.geometry import Camera

CAMERA = Camera(1000.0, (0.9, 0.9), (300, 320), (159.5, 149.5))
MIDDLE = np.array([159.5, 149.5])
PITCH_MM, BALL_PX = 13.5, 2.6  # 15 pixels apart


def bend(places: np.ndarray) -> np.ndarray:
    """Pincushion and a twist that grows outwards, as the earth's field makes it; column and row from the middle, px."""
    x, y = places[..., 0] - 159.5, places[..., 1] - 149.5
    squared = (x**2 + y**2) / 150**2
    swell, twist = 1 + 0.03 * squared, 0.02 * squared
    bent = np.stack([swell * (x - twist * y), swell * (y + twist * x)], -1)
    return bent + MIDDLE


def straight_grid() -> np.ndarray:
    i, j = np.meshgrid(np.arange(-9, 10), np.arange(-8, 9))
    angle = 0.05
    x, y = 15.0 * i + 2.0, 15.0 * j - 1.0
    places = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], -1)
    return places.reshape(-1, 2) + MIDDLE


def picture_of(places: np.ndarray, bright: bool = False) -> torch.Tensor:
    rows, columns = np.indices(CAMERA.shape)
    shade = np.zeros(CAMERA.shape)
    for column, row in places:
        shade += np.exp(-0.5 * ((columns - column) ** 2 + (rows - row) ** 2) / (BALL_PX / 1.5) ** 2)
    field = 20000 - 20 * np.hypot(columns - 150, rows - 140)  # brighter in the middle
    noise = np.random.default_rng(0).normal(0, 60, CAMERA.shape)
    return torch.from_numpy(field * np.exp((1 if bright else -1) * 0.5 * shade) + noise).float()


@pytest.mark.parametrize("bright", [False, True])
def test_a_known_distortion_is_found_and_taken_off(bright: bool) -> None:
    straight = straight_grid()
    seen = bend(straight)
    inside = (seen > 4).all(1) & (seen < [315, 295]).all(1)
    found = find_distortion(picture_of(seen[inside], bright), CAMERA, PITCH_MM, "grid.tif")
    assert found.spots > 0.97 * inside.sum()
    assert found.residual_mm < 0.1
    assert found.greatest_mm > 3
    # The grid leaves a shift and a turn of the whole picture open; but for these, straight is straight.
    again = found.straight(torch.from_numpy(seen[inside])).numpy()
    a, b = again - again.mean(0), straight[inside] - straight[inside].mean(0)
    u, _, v = np.linalg.svd(b.T @ a)
    np.testing.assert_allclose(a, b @ (u @ v), atol=0.15)
    np.testing.assert_allclose(found.bent(again), seen[inside], atol=1e-6)
    spots = find_grid_spots(found.straightened(picture_of(seen[inside], bright)))
    nearest = np.linalg.norm(spots[:, None] - again[None], axis=-1).min(1)
    assert np.median(nearest) < 0.1
    mask = found.straightened(torch.ones(CAMERA.shape, dtype=torch.bool))
    assert mask.dtype == torch.bool
    assert mask.all()


def test_what_is_no_grid_is_refused() -> None:
    with pytest.raises(InputError, match=r"grid\.tif: neighbours lie .* mm apart"):
        find_distortion(picture_of(straight_grid()), CAMERA, 40.0, "grid.tif")
    with pytest.raises(InputError, match=r"grid\.tif: "):
        find_distortion(picture_of(np.array([[100.0, 100], [200, 150]])), CAMERA, PITCH_MM, "grid.tif")
