"""Distortion of an image intensifier, against one that is known."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import find_distortion, find_grid_spots
from femoreg_torch.geometry import Camera, centred_camera

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


def ringed_grid(
    pixel_mm: tuple[float, float], top: float, ring: tuple[float, float], bright: bool
) -> tuple[Camera, torch.Tensor, np.ndarray, np.ndarray]:
    """An image intensifier's picture of a grid of 12 mm within a black ring, of level and noise `ring`.

    With its camera, the places of the straight grid, mm, and where they are seen, px, of spots wholly in the field.
    """
    shape = tuple(round(240 / mm) for mm in pixel_mm)
    camera = centred_camera(1000.0, pixel_mm, (shape[0], shape[1]))
    middle, mm = np.array(camera.principal_point_px), np.array(pixel_mm[::-1])
    line = 12.0 * np.arange(-11, 12)
    grid = np.stack(np.meshgrid(line + 1.3, line - 2.2), -1).reshape(-1, 2)
    squared = (grid**2).sum(1, keepdims=True) / 110**2
    angle = 0.05 + 0.03 * squared  # a twist that grows outwards, and pincushion
    x, y = grid[:, :1], grid[:, 1:]
    turned = np.concatenate([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], 1)
    seen = (1 + 0.05 * squared) * turned
    rows, columns = np.indices(shape)
    away = np.stack([columns, rows], -1) * mm - middle * mm
    shade = np.exp(-0.5 * cKDTree(seen).query(away)[0] ** 2 / 1.2**2)
    generator = np.random.default_rng(3)
    level = 0.5 if bright else 1.0
    picture = top * level * np.exp((0.7 if bright else -0.7) * shade) + generator.normal(0, 0.003 * top, shape)
    black = np.linalg.norm(away, axis=-1) > 112
    picture = np.where(black, generator.normal(*ring, shape), picture).clip(0).round()
    whole = np.linalg.norm(seen, axis=1) < 104
    return camera, torch.from_numpy(picture).float(), grid[whole], seen[whole] / mm + middle


@pytest.mark.parametrize("pixel_mm", [(0.5, 0.5), (0.6, 0.5)])
@pytest.mark.parametrize(
    ("top", "ring"), [(30000, (0, 0)), (30000, (200, 10)), (30000, (200, 100)), (3500, (8, 3)), (3500, (2, 2))]
)
@pytest.mark.parametrize("bright", [False, True])
def test_the_black_ring_of_an_image_intensifier_hides_no_spot(
    pixel_mm: tuple[float, float], top: float, ring: tuple[float, float], bright: bool
) -> None:
    camera, picture, straight, seen = ringed_grid(pixel_mm, top, ring, bright)
    found = find_distortion(picture, camera, 12.0, "grid.tif")
    assert found.spots >= len(seen)
    mm = np.array(pixel_mm[::-1])
    again = found.straight(torch.from_numpy(seen)).numpy() * mm
    a, b = again - again.mean(0), straight - straight.mean(0)
    u, _, v = np.linalg.svd(b.T @ a)
    assert np.abs(a - b @ (u @ v)).max() < 0.25


def test_what_is_no_grid_is_refused() -> None:
    with pytest.raises(InputError, match=r"grid\.tif: neighbours lie .* mm apart"):
        find_distortion(picture_of(straight_grid()), CAMERA, 40.0, "grid.tif")
    with pytest.raises(InputError, match=r"grid\.tif: "):
        find_distortion(picture_of(np.array([[100.0, 100], [200, 150]])), CAMERA, PITCH_MM, "grid.tif")
