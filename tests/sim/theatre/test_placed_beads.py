"""Beads of the simulated cadaver: within the bone, on the device, and found again in the CT."""

import numpy as np
import pytest
import torch
import trimesh

from femoreg_torch.beads import find_beads
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, axis_aligned
from sim.theatre.beads import PlacedBeads, ct_with_beads, device_beads, femur_beads
from sim.theatre.device import make_device

HEAD, ENTRY = torch.tensor([30.0, 30, 40]).double(), torch.tensor([62.0, 30, 20]).double()


def bone() -> Volume:
    """A block of femur, id 5, on voxels of 1 mm."""
    labels = torch.zeros(60, 60, 90, dtype=torch.uint8)
    labels[8:52, 10:50, 8:80] = 5
    return Volume(labels, axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))


def test_femur_beads_lie_deep_in_the_bone_and_apart() -> None:
    placed = femur_beads(bone(), (5,), HEAD, ENTRY, (4, 3), 1.0, torch.Generator().manual_seed(1))
    again = femur_beads(bone(), (5,), HEAD, ENTRY, (4, 3), 1.0, torch.Generator().manual_seed(1))
    assert torch.equal(placed.points, again.points)
    assert placed.points.shape == (7, 3)
    low, high = torch.tensor([8.0, 10, 8]), torch.tensor([79.0, 49, 51])
    assert ((placed.points >= low + 2) & (placed.points <= high - 2)).all()
    apart = torch.cdist(placed.points, placed.points) + 100 * torch.eye(7)
    assert apart.min() >= 7
    assert ((placed.points[:4] - HEAD).norm(dim=1) <= 14).all()
    assert ((placed.points[4:] - ENTRY).norm(dim=1) <= 22).all()


def test_no_room_is_told() -> None:
    with pytest.raises(InputError, match="no room for 90 beads"):
        femur_beads(bone(), (5,), HEAD, ENTRY, (90, 3), 1.0, torch.Generator().manual_seed(1))


def test_device_beads_touch_the_surface_and_are_spread() -> None:
    mesh, _ = make_device(3)
    placed = device_beads(mesh, 5, 1.5, seed=2)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 40_000, seed=9)[0])
    nearest = np.linalg.norm(placed.points.numpy()[:, None] - points, axis=2).min(1)
    assert ((nearest > 0.6) & (nearest < 1.1)).all()  # a radius, and the samples' distance
    assert not mesh.contains(placed.points.numpy()).any()
    apart = torch.cdist(placed.points, placed.points) + 1000 * torch.eye(5)
    assert apart.min() > 20


@pytest.mark.parametrize(("spacing", "worst_mm"), [((1.0, 1.0, 1.0), 0.15), ((1.0, 1.0, 0.5), 0.12)])
def test_beads_in_a_ct_are_found_again(spacing: tuple[float, float, float], worst_mm: float) -> None:
    points = torch.tensor([[12.3, 14.6, 11.2], [21.8, 17.1, 19.7], [15.2, 25.4, 24.9], [27.5, 12.8, 13.6]]).double()
    shape = tuple(round(40 / s) for s in spacing[::-1])
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    ct = Volume(300 + 20 * noise, axis_aligned(spacing, (0.0, 0.0, 0.0)))
    shown = ct_with_beads(ct, PlacedBeads(points, 1.0), 0.5)
    assert shown.data.max() == 3071
    assert torch.equal(ct.data, 300 + 20 * noise)  # untouched
    assert torch.cdist(points, find_beads(shown, 1.0, 4, None)[0]).min(1).values.max() < worst_mm
