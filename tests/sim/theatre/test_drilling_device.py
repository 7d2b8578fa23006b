"""The device is one closed, asymmetric body with a bore, and its points lie where its frame says."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from femoreg_torch.errors import InputError
from sim.theatre.device import make_device


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4])
def test_device_is_one_watertight_body(seed: int) -> None:
    mesh, points = make_device(seed)
    assert mesh.is_watertight
    assert mesh.is_volume
    assert mesh.volume > 0
    assert len(mesh.split(only_watertight=False)) == 1
    assert 90 < mesh.extents[2] < 115
    assert np.isclose(mesh.bounds[1, 2], points["tip"][2])
    assert np.isclose(mesh.bounds[0, 2], points["base"][2])
    assert np.allclose(points["center"], (points["tip"] + points["base"]) / 2)


def test_sleeve_is_hollow_along_the_guide_axis() -> None:
    mesh, points = make_device(1)
    axis = np.linspace((0, 0, 1), (0, 0, float(points["tip"][2]) - 1), 50)
    assert not mesh.contains(axis).any()
    wall = np.array([0, 0, float(points["tip"][2]) - 4]) + np.outer(np.linspace(0, 8, 81), [1, 0, 0])
    inside = mesh.contains(wall)
    radii = np.linspace(0, 8, 81)[inside]
    assert 1.0 < radii.min() < radii.max() <= 6.1  # bore, then the wall, 8 to 12 mm across


def _overlap(first: trimesh.Trimesh, moved: trimesh.Trimesh) -> float:
    both = trimesh.boolean.intersection([first, moved]).volume
    return float(both / (first.volume + moved.volume - both))


def test_no_turn_about_the_guide_and_no_mirror_leaves_it_alike() -> None:
    mesh, _ = make_device(2)
    for angle in range(30, 360, 30):
        turned = mesh.copy()
        turned.vertices = mesh.vertices @ Rotation.from_euler("z", angle, degrees=True).as_matrix().T
        assert _overlap(mesh, turned) < 0.7
    for axis in range(3):
        mirror = np.eye(4)
        mirror[axis, axis] = -1
        mirror[axis, 3] = 2 * mesh.centroid[axis]
        flipped = mesh.copy()
        flipped.apply_transform(mirror)
        if flipped.volume < 0:
            flipped.invert()
        assert _overlap(mesh, flipped) < 0.85


def test_seed_decides_every_vertex() -> None:
    first, again, other = make_device(5)[0], make_device(5)[0], make_device(6)[0]
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(first.faces, again.faces)
    assert not np.allclose(first.extents, other.extents)
    with pytest.raises(InputError, match="seed"):
        make_device(-1)
