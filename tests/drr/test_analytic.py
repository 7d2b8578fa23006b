"""Line integrals known in closed form: balls, boxes and slabs."""

import pytest
import torch
from drr_scenes import (
    CAMERA,
    DEVIATING_CAMERA,
    ball_integral,
    box_chord,
    centred,
    distances,
    facing,
    float64,
    gaussian_ball,
    voxel_positions,
)
from torch.testing import assert_close

from femoreg_torch.drr import project
from femoreg_torch.geometry import centred_camera
from femoreg_torch.volume.grid import Volume

MU = 0.02  # 1/mm
POSES = {
    "ahead": facing(),
    "turned": facing(600, (0.3, -0.5, 0.2), x_mm=15, y_mm=-20),
    "aside": facing(560, (2.0, 1.0, -0.5), x_mm=-40, y_mm=30),
    "near the detector": facing(990, (0.1, 0.7, 0.0), x_mm=30),
}


def box(size: tuple[int, int, int]) -> Volume:
    """A box of mu = MU about the origin, of 1 mm voxels; its faces lie half a voxel outside the outermost centres."""
    return centred(torch.full(size[::-1], MU))


@pytest.mark.parametrize("camera", [CAMERA, DEVIATING_CAMERA], ids=["square", "off centre"])
@pytest.mark.parametrize("pose", POSES.values(), ids=POSES.keys())
def test_a_gaussian_ball_is_its_closed_form(pose, camera):
    centre = float64(4.3, -7.1, 2.6)
    ball = gaussian_ball(centred(torch.zeros(90, 80, 84), (1.0, 1.0, 0.9)), centre, sigma_mm=6.0)
    centre_camera = pose[0, 0, :3, :3] @ centre + pose[0, 0, :3, 3]
    expected = ball_integral(distances(camera, centre_camera), 6.0)
    image = project([ball], pose, camera)[0]
    bound = 2 / 8 / 6.0**2  # of linear interpolation, h² / 8 · f'', in the two directions across the ray
    assert_close(image, expected.float(), atol=1.1 * bound * expected.max().item(), rtol=0)
    assert_close(image.sum().item(), expected.sum().item(), rtol=2e-3, atol=0)


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES.keys())
def test_a_sphere_is_its_chord(pose):
    grid = centred(torch.zeros(96, 96, 96), (0.5, 0.5, 0.5))
    radius = voxel_positions(grid).norm(dim=-1)
    sphere = grid.with_data((MU * ((20.0 - radius) / 0.5 + 0.5).clamp(0, 1)).float())
    distance = distances(CAMERA, pose[0, 0, :3, 3])
    image = project([sphere], pose, CAMERA, step_mm=0.1)[0].double()
    inside = distance < 18
    assert inside.sum() > 40
    chord = 2 * MU * (400 - distance[inside] ** 2).sqrt()
    assert_close(image[inside], chord, rtol=1e-2, atol=0)  # the radius is known to a twelfth of a voxel
    assert_close(image[inside].sum(), chord.sum(), rtol=3e-3, atol=0)
    assert not image[distance > 21].any()


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES.keys())
def test_a_box_is_its_chord(pose):
    size = (50, 36, 44)
    chord, clear = box_chord(CAMERA, pose[0, 0], float64(*size) / 2)
    image = project([box(size)], pose, CAMERA, step_mm=0.1)[0].double()
    assert (clear & (chord > 5)).sum() > 100
    assert_close(image[clear], MU * chord[clear], atol=1e-4 * MU * 50, rtol=0)
    assert not image[clear & (chord == 0)].any()


def test_a_slab_is_its_thickness_over_the_slant_of_the_ray():
    slab = centred(torch.full((40, 90, 90), MU), (4, 4, 1))
    cosines = 1020 / CAMERA.pixel_positions().norm(dim=-1)
    image = project([slab], facing(), CAMERA, step_mm=0.1)[0]
    assert_close(image, (40 * MU / cosines).float(), rtol=5e-5, atol=0)


@pytest.mark.parametrize(("face_mm", "share"), [(2.0, 1.0), (0.0, 0.5), (-1.0, 0.0)])
def test_a_ray_along_a_face(face_mm, share):
    """The central ray runs parallel to the +x face: inside the box, in the face (faded to one half), or beyond it."""
    one_ray = centred_camera(1020.0, (1.0, 1.0), (1, 1))
    image = project([box((30, 20, 40))], facing(x_mm=face_mm - 15), one_ray, step_mm=0.1)
    assert_close(image.item(), share * 40 * MU, rtol=1e-5, atol=0)


def test_a_source_inside_the_box_sees_what_is_before_it():
    """The box's middle lies 10 mm behind the source: 20 of its 60 mm are in front, known to one step."""
    one_ray = centred_camera(1020.0, (1.0, 1.0), (1, 1))
    image = project([box((60, 60, 60))], facing(z_mm=-10.0), one_ray, step_mm=0.1)
    assert_close(image.item(), 20 * MU, atol=0.1 * MU, rtol=1e-4)


def test_rays_that_miss_and_volumes_behind_the_source_give_exactly_zero():
    block = box((20, 20, 20))
    assert not project([block], facing(x_mm=300.0), CAMERA).any()
    assert not project([block], facing(z_mm=-200.0), CAMERA).any()
    image = project([block], facing(), CAMERA)[0]
    assert image.any()
    assert not image[0].any()
    assert not image[:, -1].any()
