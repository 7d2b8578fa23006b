"""Levels count mm on the detector: whatever the binning of the images, the same pixels and nearly the same costs."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, float64, make_scene, off, true_poses
from scipy.spatial.transform import Rotation

from femoreg_torch.drr import project
from femoreg_torch.fluoro import binned
from femoreg_torch.geometry import centred_camera, rigid
from femoreg_torch.registration import Level
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.level import binning
from femoreg_torch.registration.scene import Body
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume, axis_aligned, voxelise_mesh
from sim.physics.mesh_paths import mesh_paths
from sim.theatre.device import make_device


@pytest.mark.parametrize(
    ("pixel_mm", "pixels"),
    [(0.1, 1), (1.0, 1), (1.41, 1), (1.42, 2), (2.44, 2), (2.46, 3), (7.9, 8)],  # √2 and √6 lie half-way
)
def test_the_nearest_whole_factor_by_ratio(pixel_mm: float, pixels: int) -> None:
    assert binning(pixel_mm, centred_camera(1000.0, (1.0, 1.0), (64, 64))) == pixels
    assert binning(pixel_mm, centred_camera(1000.0, (0.5, 2.0), (64, 64))) == pixels


def test_images_binned_two_by_two_with_their_camera_are_seen_alike() -> None:
    poses = true_poses((0,))
    scene = make_scene(poses)
    coarser = replace(
        scene,
        carm=replace(CARM, camera=CARM.camera.downsampled(2)),
        images={kind: tuple(binned(image, 2) for image in images) for kind, images in scene.images.items()},
    )
    level = Level(pixel_mm=12, step_mm=2)
    camera = level.camera(CARM.camera)
    assert camera == level.camera(coarser.carm.camera)
    assert camera.pixel_mm == (12, 12)
    finely, coarsely = (level.image(s.images["anatomy"][0], s.carm.camera) for s in (scene, coarser))
    torch.testing.assert_close(finely, coarsely, atol=1e-6, rtol=1e-5)
    wrong = off(poses.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (1, 2, 0), (3, 0, 0))
    body = Body(("pelvis",), 0, float64(0, 0, 740), float64(0.02, 0.02, 0.02, 2, 2, 12))
    deltas = torch.eye(6, dtype=torch.float64)
    one, other = (
        image_costs(
            s, poses.with_object("pelvis", wrong), (body,), ["pelvis", "femur"], [("anatomy", 0)], level, GradNcc(2)
        )(deltas)
        for s in (scene, coarser)
    )
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)
    assert one.std() > 1e-3


def test_voxels_are_as_large_as_the_steps_allow() -> None:
    volume = Volume(torch.rand(8, 8, 8), axis_aligned((1.0, 1.0, 0.5), (0.0, 0.0, 0.0)))
    assert Level(3.0, 1.9).volume(volume) is volume
    twice = Level(3.0, 2.0).volume(volume)
    assert twice.spacing_mm == pytest.approx((2.0, 2.0, 1.0))
    assert Level(6.0, 3.0).volume(volume) is twice  # made once
    assert Level(6.0, 4.0).volume(volume).spacing_mm == pytest.approx((4.0, 4.0, 2.0))
    volume.data.add_(1)  # in place: made anew
    torch.testing.assert_close(Level(3.0, 2.0).volume(volume).data, twice.data + 1)


def test_an_image_that_changes_in_place_is_averaged_anew() -> None:
    level, image = Level(2.0, 1.0), torch.ones(8, 8)
    camera = centred_camera(1000.0, (1.0, 1.0), (8, 8))
    before = level.image(image, camera)
    assert level.image(image, camera) is before
    image += 1
    torch.testing.assert_close(level.image(image, camera), before + 1)


def test_solids_are_drawn_as_sharp_as_their_surfaces() -> None:
    """A blurred edge of thick metal takes more light than the metal does; beside exact paths through a device."""
    mesh, _ = make_device(2)
    solid = voxelise_mesh(mesh, 0.5, 1000.0)
    device = solid.with_data(solid.data / solid.data.max())
    camera = centred_camera(1000.0, (0.5, 0.5), (200, 200))
    turn = torch.from_numpy(Rotation.from_euler("xyz", (70, 40, 30), degrees=True).as_matrix())
    pose = rigid(turn, float64(0, 20, 590))
    exact = mesh_paths(mesh, pose, camera)
    steel = 0.5  # 1/mm

    def too_much(level: Level, sharp: bool) -> float:
        drawn = project([level.volume(device, sharp=sharp)], pose[None, None], camera, 0.5)[0]
        taken, truly = (1 - (-steel * paths).exp() for paths in (drawn, exact))
        return float(taken.sum() / truly.sum()) - 1

    fine, coarse = Level(0.5, 0.5), Level(0.5, 1.0)
    assert too_much(fine, sharp=False) > 0.01
    assert abs(too_much(fine, sharp=True)) < 0.2 * too_much(fine, sharp=False)
    assert abs(too_much(coarse, sharp=True)) < 0.3 * too_much(coarse, sharp=False)
    assert fine.volume(device) is device
    assert fine.volume(device, sharp=True) is Level(2.0, 0.9).volume(device, sharp=True)  # made once
    assert max(coarse.volume(device, sharp=True).spacing_mm) == 1.0
