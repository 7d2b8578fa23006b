"""Spheres in the beam: chords in closed form, and the whole mass of each."""

import numpy as np
import pytest
import torch

from femoreg_torch.geometry import centred_camera
from sim.physics.spheres import areal_spheres

CAMERA = centred_camera(1000.0, (0.2, 0.2), (121, 161))


def test_the_middle_ray_crosses_the_diameter() -> None:
    fine = centred_camera(1000.0, (0.01, 0.01), (51, 51))
    image = areal_spheres(torch.tensor([[0.0, 0, 700]]), 0.5, 8.0, fine)
    assert image[25, 25].item() == pytest.approx(0.1 * 8.0, rel=1e-4)  # 1 mm of 8 g/cm³, in g/cm²


@pytest.mark.parametrize("place", [(0.0, 0.0, 700.0), (3.3, -2.1, 640.0)])
def test_the_shadow_holds_the_sphere(place: tuple[float, float, float]) -> None:
    """Integrated over the detector, the chords are the volume, magnified in both directions."""
    image = areal_spheres(torch.tensor([place]), 0.75, 7.95, CAMERA)
    volume_cm3 = 4 / 3 * np.pi * 0.075**3
    magnified = (1000 / place[2]) ** 2
    assert image.sum().item() * 0.02**2 == pytest.approx(volume_cm3 * 7.95 * magnified, rel=5e-3)
    rows, columns = torch.meshgrid(torch.arange(121.0), torch.arange(161.0), indexing="ij")
    centre = [(image * axis).sum() / image.sum() for axis in (columns, rows)]
    assert centre[0].item() == pytest.approx(80 + place[0] / place[2] * 1000 / 0.2, abs=0.02)
    assert centre[1].item() == pytest.approx(60 + place[1] / place[2] * 1000 / 0.2, abs=0.02)


def test_spheres_beside_the_detector_or_behind_the_source_are_not_drawn() -> None:
    places = torch.tensor([[500.0, 0, 700], [0.0, 0, -700]])
    assert areal_spheres(places, 0.5, 8.0, CAMERA).abs().max() == 0


def test_spheres_add_up() -> None:
    places = torch.tensor([[0.0, 0, 700], [0.1, 0.1, 650], [4.0, 3.0, 600]])
    apart = sum(areal_spheres(place[None], 0.5, 8.0, CAMERA) for place in places)
    torch.testing.assert_close(areal_spheres(places, 0.5, 8.0, CAMERA), apart)
