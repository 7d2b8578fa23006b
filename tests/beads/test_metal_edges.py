"""Beads over the silhouette of a device: drawn by its model, measured again without the step of its edge."""

import numpy as np
import pytest
import trimesh
from bead_scenes import CAMERA
from scipy import ndimage
from scipy.optimize import least_squares

from femoreg_torch.beads.edges import Metal, in_beam, measured_again
from femoreg_torch.beads.spots import shadow

LOW, HIGH = np.array([-30.0, -6, 540]), np.array([30.0, 6, 552])  # of a bar in front of the camera, mm
BEAD_MM = 1.5


def slab_lengths(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Millimetres of the bar along the rays of pixels, by the slabs between its faces."""
    x, y = CAMERA.principal_point_px
    rays = np.stack([(columns - x) * 0.194, (rows - y) * 0.194, np.full(columns.shape, 1020.0)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    with np.errstate(divide="ignore"):
        ends = np.stack([LOW / rays, HIGH / rays])
    return (ends.max(0).min(-1) - ends.min(0).max(-1)).clip(0)


def bar(weight: float = 1.0) -> Metal:
    """The same as a surface."""
    box = trimesh.creation.box(bounds=np.stack([LOW, HIGH]))
    return Metal((np.asarray(box.triangles),), (weight,))


def test_metal_in_the_beam_is_that_between_the_faces() -> None:
    rng = np.random.default_rng(0)
    columns, rows = rng.uniform(300, 1200, 500), rng.uniform(600, 900, 500)
    expected = slab_lengths(columns, rows)
    assert 50 < (expected > 0).sum() < 450
    np.testing.assert_allclose(in_beam(bar(), CAMERA, columns, rows), expected, atol=1e-6)
    np.testing.assert_allclose(in_beam(bar(0.5), CAMERA, columns, rows), expected / 2, atol=1e-6)


@pytest.fixture(scope="module")
def pictured() -> tuple[np.ndarray, np.ndarray, float]:
    """An image (H, W) of a bead over an edge of the bar, its centre, and its radius in pixels, from exact chords.

    The middle of the bead lies 0.6 mm beside the edge. Scattered light fills the shadow of the metal.
    """
    left, top, parts = 700, 780, 6
    size = 120
    offsets = (np.arange(parts) + 0.5) / parts - 0.5
    line = (np.arange(size)[:, None] + offsets).ravel()
    rows, columns = np.meshgrid(line + top, line + left, indexing="ij")
    edge_row = 767.5 + 6 / 540 * 1020 / 0.194
    depth = 539.0
    centre = np.array([760.3, edge_row + 0.6 / depth * 1020 / 0.194])
    radius = BEAD_MM / 2 / depth * 1020 / 0.194
    chord = BEAD_MM * np.sqrt(np.clip(1 - ((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2) / radius**2, 0, None))
    metal = 0.03 * slab_lengths(columns, rows) + 0.2 * chord
    light = (np.exp(-metal) + 0.1).reshape(size, parts, size, parts).mean((1, 3))
    light = ndimage.gaussian_filter(light, 0.85)
    image = np.zeros(CAMERA.shape)
    noise = np.random.default_rng(1).normal(0, 0.004, light.shape)
    image[top : top + size, left : left + size] = 2 - np.log(light) + noise
    return image, centre, radius


def test_a_bead_over_an_edge_is_measured_without_its_step(pictured: tuple[np.ndarray, np.ndarray, float]) -> None:
    image, centre, radius = pictured
    first = (float(centre[0]) + 0.6, float(centre[1]) - 0.5)
    again = measured_again(image, first, radius, BEAD_MM, [bar()], CAMERA)
    assert again is not None
    pixel, deviation = again
    assert np.linalg.norm(pixel - centre) < 0.05
    assert deviation < 0.05
    u, v = (values.ravel() for values in np.meshgrid(np.arange(-14, 15), np.arange(-14, 15)))
    values = image[round(centre[1]) + v, round(centre[0]) + u]
    surface = np.stack([np.ones(u.shape), u, v, u * u, u * v, v * v], 1)

    def residuals(place: np.ndarray) -> np.ndarray:
        terms = np.column_stack([shadow(radius, np.hypot(u - place[0], v - place[1])), surface])
        return values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]

    by_surface = least_squares(residuals, (0.0, 0.0)).x + np.round(centre)
    assert np.linalg.norm(by_surface - centre) > 0.3  # what a surface alone would make of it


def test_what_no_metal_stands_beside_stays(pictured: tuple[np.ndarray, np.ndarray, float]) -> None:
    image, centre, radius = pictured
    first = (float(centre[0]), float(centre[1]))
    far = Metal(tuple(faces + np.array([200.0, 0, 0]) for faces in bar().triangles), (1.0,))
    found = measured_again(image, first, radius, BEAD_MM, [far], CAMERA)
    assert found is not None
    assert found[0] == first
    assert measured_again(image, (3.0, 900.0), radius, BEAD_MM, [bar()], CAMERA) is None
