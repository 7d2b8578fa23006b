"""The CPU kernel against the plain march in float64, over volumes, affines, poses and detectors of all kinds."""

import pytest
import torch
from drr_scenes import (
    CAMERA,
    DEVIATING_CAMERA,
    centred,
    facing,
    marched,
    random_poses,
    relative_error,
    smooth,
    sparse,
    truth,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, centred_camera
from femoreg_torch.volume.grid import Volume

TOLERANCE = 2e-5  # float32 sums of some hundred samples, relative to the largest pixel

sizes = st.tuples(*[st.integers(1, 33)] * 3)
spacings = st.tuples(*[st.floats(0.4, 4.0)] * 3)
rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
fillings = st.sampled_from([smooth, sparse])


@given(
    size=sizes,
    spacing=spacings,
    grid_rotation=rotations,
    filling=fillings,
    pose_rotation=rotations,
    place=st.tuples(st.floats(-60, 60), st.floats(-60, 60), st.floats(-20, 1000)),
    pixel=st.tuples(st.floats(0.1, 9.0), st.floats(0.1, 9.0)),
    step=st.sampled_from([0.5, 1.0, 2.3]),
    seed=st.integers(0, 9),
)
@example((1, 1, 1), (1, 1, 1), (0, 0, 0), sparse, (0, 0, 0), (0, 0, 600), (1, 1), 1.0, 0)
@settings(max_examples=40, deadline=None, derandomize=True)
def test_any_volume_in_any_pose(size, spacing, grid_rotation, filling, pose_rotation, place, pixel, step, seed):
    volume = centred(filling(size, torch.Generator().manual_seed(seed)), spacing, grid_rotation)
    x, y, z = place
    pose = facing(z, pose_rotation, x, y)
    camera = Camera(1000.0, pixel, (11, 13), (5.2, 6.1))
    expected = truth([volume], pose, camera, step)
    image = project([volume], pose, camera, step)
    assert (image.double() - expected[:, 0]).abs().max() <= TOLERANCE * max(expected.max().item(), 1e-3)


@pytest.mark.parametrize("camera", [CAMERA, DEVIATING_CAMERA], ids=["square", "off centre"])
@pytest.mark.parametrize("filling", [smooth, sparse])
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.7, 0.9, 2.5), (2.5, 2.5, 0.6)], ids=str)
def test_larger_volumes_with_long_empty_stretches(spacing, filling, camera):
    generator = torch.Generator().manual_seed(3)
    data = torch.zeros(70, 60, 80)
    data[8:20, 10:50, 5:75] = filling((12, 40, 70), generator)
    data[55:69, 40:58, 20:40] = filling((14, 18, 20), generator)
    volume = centred(data, spacing, (0.2, -0.4, 0.3))
    poses = random_poses(3, 1, generator)
    assert relative_error(project([volume], poses, camera), truth([volume], poses, camera)[:, 0]) < TOLERANCE


@pytest.mark.parametrize("pixel_mm", [0.05, 0.6, 2.0, 8.0])
def test_packets_of_one_ray_and_of_many(pixel_mm):
    """From pixels so fine that many rays share a voxel, to pixels that skip several voxels of 0.5 mm."""
    generator = torch.Generator().manual_seed(4)
    volume = centred(sparse((40, 44, 48), generator, share=0.003), (0.5, 0.5, 0.5))
    camera = centred_camera(1020.0, (pixel_mm, pixel_mm), (31, 33))
    poses = random_poses(3, 1, generator, z_mm=800)
    poses[..., :2, 3] *= 0.02 if pixel_mm < 1 else 0.2
    expected = truth([volume], poses, camera)[:, 0]
    assert expected.max() > 0
    assert relative_error(project([volume], poses, camera), expected) < TOLERANCE


def test_rays_along_the_grid():
    """Whole steps on whole voxels: every sample lies on a boundary that the skipping must not fall over."""
    generator = torch.Generator().manual_seed(5)
    volume = centred(sparse((33, 31, 29), generator, share=0.005))
    camera = centred_camera(1e6, (1.0, 1.0), (41, 41))
    for axis in ((0.0, 0.0, 0.0), (1.5707963267948966, 0.0, 0.0), (0.0, 1.5707963267948966, 0.0)):
        for shift in (0.0, 0.5):
            pose = facing(999_990.0, axis, shift, shift)
            assert relative_error(project([volume], pose, camera), truth([volume], pose, camera)[:, 0]) < TOLERANCE


@pytest.mark.parametrize("z_mm", [0.0, 8.0, -15.0, 1015.0])
def test_a_volume_about_the_source_and_one_that_reaches_through_the_detector(z_mm):
    generator = torch.Generator().manual_seed(6)
    volume = centred(smooth((40, 50, 60), generator), rotation_vector=(0.3, 0.2, 0.1))
    pose = facing(z_mm, x_mm=3.3, y_mm=-4.7)
    assert relative_error(project([volume], pose, CAMERA), truth([volume], pose, CAMERA)[:, 0]) < TOLERANCE


def test_a_mirrored_grid():
    """DICOM and NIfTI grids may run right to left: the affine then has a negative determinant."""
    generator = torch.Generator().manual_seed(7)
    volume = centred(sparse((30, 34, 38), generator), (1.0, 1.2, 0.8))
    mirrored = volume.lps_from_index.clone()
    mirrored[0] *= -1
    poses = random_poses(2, 1, generator)
    found = project([Volume(volume.data, mirrored)], poses, CAMERA)
    assert relative_error(found, truth([Volume(volume.data, mirrored)], poses, CAMERA)[:, 0]) < TOLERANCE


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 2, 3), (5, 1, 1), (3, 3, 3)])
def test_tiny_volumes(shape):
    generator = torch.Generator().manual_seed(8)
    volume = centred(1 + torch.rand(shape, generator=generator), (9.0, 8.0, 7.0))
    poses = random_poses(3, 1, generator)
    assert relative_error(project([volume], poses, CAMERA), truth([volume], poses, CAMERA)[:, 0]) < TOLERANCE


def test_negative_values_count():
    generator = torch.Generator().manual_seed(9)
    volume = centred(torch.randn(20, 20, 20, generator=generator))
    poses = random_poses(2, 1, generator)
    expected = truth([volume], poses, CAMERA)[:, 0]
    assert (project([volume], poses, CAMERA).double() - expected).abs().max() < TOLERANCE * expected.abs().max()


def test_an_empty_volume_is_exactly_zero():
    empty = centred(torch.zeros(20, 30, 40))
    assert not project([empty], facing(), CAMERA).any()


def test_any_memory_layout_of_data_and_poses():
    generator = torch.Generator().manual_seed(10)
    data = smooth((20, 24, 28), generator)
    poses = random_poses(2, 1, generator)
    expected = project([centred(data)], poses, CAMERA)
    strided = torch.zeros(28, 24, 20).permute(2, 1, 0)
    strided.copy_(data)
    assert torch.equal(project([centred(strided)], poses, CAMERA), expected)
    assert torch.equal(project([centred(data)], poses.mT.contiguous().mT, CAMERA), expected)


def test_poses_in_float32_are_good_to_their_own_rounding():
    generator = torch.Generator().manual_seed(11)
    volume = centred(smooth((30, 30, 30), generator))
    poses = random_poses(2, 1, generator)
    assert relative_error(project([volume], poses.float(), CAMERA), truth([volume], poses, CAMERA)[:, 0]) < TOLERANCE


def test_data_made_under_inference_mode_are_refused():
    """Torch does not count changes of such data, so that a stale image could not be told."""
    with torch.inference_mode():
        volume = centred(torch.ones(4, 4, 4))
        with pytest.raises(InputError, match="no_grad"):
            project([volume], facing(), CAMERA)
    usual = centred(torch.ones(4, 4, 4))
    with torch.inference_mode():
        assert project([usual], facing(), CAMERA).any()


@pytest.mark.parametrize("z_mm", [620.0, 4.0])
def test_the_plain_march_agrees_with_scipy(z_mm):
    generator = torch.Generator().manual_seed(13)
    volumes = [centred(smooth((9, 12, 15), generator), (2, 1, 1.5)), centred(sparse((8, 8, 8), generator, 0.1))]
    poses = random_poses(2, 2, generator, z_mm)
    assert relative_error(marched(volumes, poses, CAMERA), truth(volumes, poses, CAMERA)) < 1e-12
