"""Paths through closed meshes: those of balls, boxes and tubes that are known, whole pixel by pixel, never negative."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, centred_camera, rigid
from femoreg_torch.volume import voxelise_mesh
from sim.physics.mesh_paths import mesh_paths
from sim.theatre.device import make_device

CAMERA = Camera(1000.0, (0.9, 1.1), (150, 170), (80.3, 71.6))


def at(x: float, y: float, z: float) -> torch.Tensor:
    return rigid(translation=torch.tensor([x, y, z], dtype=torch.float64))


def unit_rays(camera: Camera) -> torch.Tensor:
    rays = camera.pixel_positions()
    return rays / rays.norm(dim=-1, keepdim=True)


def through_box(camera: Camera, low: tuple[float, ...], high: tuple[float, ...]) -> torch.Tensor:
    """Exact paths (H, W) through a box along the camera's axes, by its slabs."""
    rays = unit_rays(camera)
    faces = torch.stack([torch.tensor(low, dtype=torch.float64) / rays, torch.tensor(high, dtype=torch.float64) / rays])
    enter, leave = faces.amin(0).amax(-1), faces.amax(0).amin(-1)
    return (leave - enter).clamp_min(0)


def test_paths_through_a_box_are_exact() -> None:
    box = trimesh.creation.box(bounds=[[-21.3, -13.7, 580.0], [33.1, 30.2, 620.0]])
    found = mesh_paths(box, at(0, 0, 0), CAMERA)
    known = through_box(CAMERA, (-21.3, -13.7, 580.0), (33.1, 30.2, 620.0))
    assert known.max() > 39
    torch.testing.assert_close(found.double(), known, atol=1e-4, rtol=0)


def test_paths_through_a_ball_are_those_of_a_ball() -> None:
    ball = trimesh.creation.icosphere(5, radius=20.0)
    ball.apply_scale((20**3 * 4 / 3 * math.pi / ball.volume) ** (1 / 3))  # as large as the ball
    found = mesh_paths(ball, at(3, -5, 640), CAMERA).double()
    middle = torch.tensor([3.0, -5.0, 640.0], dtype=torch.float64)
    along = unit_rays(CAMERA) @ middle
    known = 2 * (400 - (middle @ middle - along**2)).clamp_min(0).sqrt()
    assert found.sum().item() == pytest.approx(known.sum().item(), rel=1e-3)
    inside = known > 10
    assert (found - known)[inside].abs().max() < 0.05


def test_a_tube_is_hollow() -> None:
    tube = trimesh.creation.annulus(r_min=8.0, r_max=10.0, height=60.0, sections=256)  # along the middle ray
    camera = centred_camera(1000.0, (0.5, 0.5), (101, 101))
    found = mesh_paths(tube, at(0, 0, 600), camera)
    assert found[50, 50] == 0
    upright = rigid(torch.from_numpy(Rotation.from_euler("x", 90, degrees=True).as_matrix()))
    across = mesh_paths(tube, at(0, 0, 600) @ upright, camera)
    assert across[50, 50].item() == pytest.approx(4.0, abs=0.01)  # its two walls
    assert across.max().item() == pytest.approx(2 * math.sqrt(10**2 - 8**2), rel=0.03)  # along a wall


@given(
    angles=st.tuples(*[st.sampled_from([0.0, 90.0, 45.0]) | st.floats(-180, 180)] * 3),
    shift=st.tuples(*[st.sampled_from([0.0, 0.5]) | st.floats(-60, 60)] * 3),
    seed=st.integers(0, 3),
)
@settings(max_examples=40, deadline=None)
def test_no_pixel_leaks(angles: tuple[float, ...], shift: tuple[float, ...], seed: int) -> None:
    """Every ray leaves as often as it enters, also where it hits edges and vertices, and past the detector's border."""
    mesh, _ = make_device(seed)
    pose = at(*shift[:2], 600 + shift[2]) @ rigid(
        torch.from_numpy(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    )
    camera = centred_camera(1000.0, (1.0, 1.0), (121, 121))  # a pixel at the middle ray
    found = mesh_paths(mesh, pose, camera)
    assert found.min() >= -1e-3
    assert found.max() < mesh.extents.max() * 1.5
    corners = np.asarray(mesh.vertices) @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
    pixels = corners[:, :2] / corners[:, 2:] * 1000 + 60
    low, high = pixels.min(0), pixels.max(0)
    columns, rows = np.meshgrid(np.arange(121), np.arange(121))
    outside = (columns < low[0]) | (columns > high[0]) | (rows < low[1]) | (rows > high[1])
    assert (found.numpy()[outside] == 0).all()


def test_the_projector_sees_the_same_mass_less_sharply() -> None:
    mesh, _ = make_device(2)
    pose = at(5, -10, 590) @ rigid(torch.from_numpy(Rotation.from_euler("xyz", (80, 15, 30), degrees=True).as_matrix()))
    exact = mesh_paths(mesh, pose, CAMERA).double()
    solid = voxelise_mesh(mesh, 0.5, 1000.0)
    drawn = project([solid.with_data(solid.data / solid.data.max())], pose[None, None], CAMERA, 0.25)[0].double()
    assert drawn.sum().item() == pytest.approx(exact.sum().item(), rel=5e-3)
    inside = (exact > 0) & (drawn > 0)
    assert (drawn - exact)[inside].abs().mean() < 0.5


def test_nothing_lies_behind_the_source() -> None:
    with pytest.raises(InputError, match="behind the source"):
        mesh_paths(trimesh.creation.box((10, 10, 10)), at(0, 0, 4), CAMERA)
