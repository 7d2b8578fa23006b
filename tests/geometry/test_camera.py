"""The camera against OpenCV, and its windows and coarser grids against plain array slicing and averaging."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, CameraChange, centred_camera, exp_se3, project_points, transform_points

CAMERA = Camera(1020.0, (0.3, 0.2), (120, 161), (71.25, 65.5))  # rows and columns of different size, off centre


def test_the_central_ray_of_a_centred_camera_meets_the_middle_of_the_detector():
    camera = centred_camera(1020.0, (0.194, 0.194), (1536, 1536))
    assert camera.principal_point_px == (767.5, 767.5)
    assert_close(project_points(camera, torch.tensor([[0.0, 0.0, 500.0]])), torch.tensor([[767.5, 767.5]]))


def test_columns_grow_with_x_and_rows_with_y():
    """1 mm aside at half the source distance is 2 mm on the detector: 10 columns of 0.2 mm, 6.67 rows of 0.3 mm."""
    pixels = project_points(CAMERA, torch.tensor([[1.0, 0.0, 510.0], [0.0, 1.0, 510.0]], dtype=torch.float64))
    assert_close(pixels, torch.tensor([[81.25, 65.5], [71.25, 65.5 + 2 / 0.3]], dtype=torch.float64))


def test_projection_agrees_with_opencv():
    generator = torch.Generator().manual_seed(0)
    points = 80 * torch.randn(50, 3, generator=generator, dtype=torch.float64)
    twist = torch.tensor([0.4, -0.3, 0.2, 10.0, 20.0, 700.0], dtype=torch.float64)
    camera_from_points = exp_se3(twist)
    truth, _ = cv2.projectPoints(
        points.numpy(), twist[:3].numpy(), camera_from_points[:3, 3].numpy(), CAMERA.matrix().numpy(), np.zeros(5)
    )
    pixels = project_points(CAMERA, transform_points(camera_from_points, points))
    assert_close(pixels, torch.from_numpy(truth).reshape(-1, 2), atol=1e-11, rtol=0)


def test_pixel_positions_project_onto_their_own_pixels():
    pixels = project_points(CAMERA, CAMERA.pixel_positions() * 0.37)
    rows, columns = torch.meshgrid(torch.arange(120.0), torch.arange(161.0), indexing="ij")
    assert_close(pixels, torch.stack([columns, rows], -1).double(), atol=1e-12, rtol=0)


def test_points_at_or_behind_the_source_are_nan_and_leave_gradients_finite():
    points = torch.tensor([[0.0, 0.0, -1.0], [3.0, 2.0, 0.0], [3.0, 2.0, 10.0]], requires_grad=True)
    pixels = project_points(CAMERA, points)
    assert pixels.isnan().tolist() == [[True, True], [True, True], [False, False]]
    pixels[2].sum().backward()
    assert torch.isfinite(points.grad).all()


def test_a_window_is_a_crop():
    window = CAMERA.window(slice(10, 90), slice(-40, None))
    assert window.shape == (80, 40)
    assert_close(window.pixel_positions(), CAMERA.pixel_positions()[10:90, -40:], atol=1e-12, rtol=0)
    strided = CAMERA.window(slice(3, None, 4), slice(5, 150, 7))
    assert_close(strided.pixel_positions(), CAMERA.pixel_positions()[3::4, 5:150:7], atol=1e-12, rtol=0)


@pytest.mark.parametrize("factor", [2, 4, 7])
def test_a_coarser_pixel_lies_in_the_middle_of_those_it_averages(factor):
    coarse = CAMERA.downsampled(factor)
    rows, columns = coarse.shape
    fine = CAMERA.pixel_positions()[: rows * factor, : columns * factor]
    blocks = fine.reshape(rows, factor, columns, factor, 3).mean((1, 3))
    assert_close(coarse.pixel_positions(), blocks, atol=1e-12, rtol=0)
    assert (rows, columns) == (120 // factor, 161 // factor)


def test_two_steps_of_downsampling_are_one():
    twice = CAMERA.downsampled(2).downsampled(2)
    assert_close(twice.pixel_positions(), CAMERA.downsampled(4).pixel_positions(), atol=1e-12, rtol=0)


def test_a_centred_camera_stays_centred():
    camera = centred_camera(1020.0, (0.194, 0.194), (1536, 1536)).downsampled(4)
    assert camera.principal_point_px == (191.5, 191.5)
    assert math.isclose(camera.pixel_mm[0], 0.776)


@pytest.mark.parametrize("rows", [slice(5, 5), slice(9, 3), slice(200, 300), slice(None, None, -1)])
def test_an_empty_window_is_refused(rows):
    with pytest.raises(InputError, match="empty"):
        CAMERA.window(rows, slice(None))


@pytest.mark.parametrize(
    ("sdd", "pixel", "shape"),
    [
        (0.0, (1.0, 1.0), (4, 4)),
        (1000.0, (1.0, -1.0), (4, 4)),
        (1000.0, (1.0, 1.0), (0, 4)),
        (math.nan, (1, 1), (4, 4)),
    ],
)
def test_an_impossible_camera_is_refused(sdd, pixel, shape):
    with pytest.raises(InputError, match="positive"):
        centred_camera(sdd, pixel, shape)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"sdd_mm": math.inf}, "sdd_mm must be finite"),
        ({"sdd_mm": 1e200}, "sdd_mm must be finite"),
        ({"pixel_mm": (0.3, math.inf)}, "pixel_mm must be finite"),
        ({"pixel_mm": (1e-30, 0.3)}, "pixel_mm must be finite"),
        ({"pixel_mm": (0.3,)}, "pixel_mm must be two numbers"),
        ({"principal_point_px": (math.nan, 4.0)}, "principal_point_px must be finite"),
        ({"principal_point_px": (4.0, -math.inf)}, "principal_point_px must be finite"),
        ({"shape": (40.0, 60.0)}, "two whole numbers"),
        ({"shape": (40, 60, 1)}, "shape must be two"),
    ],
)
def test_values_that_no_camera_has_are_refused_by_name(values, says):
    with pytest.raises(InputError, match=says):
        replace(CAMERA, **values)


def test_whole_numbers_of_numpy_and_parallel_beams_are_fine():
    assert replace(CAMERA, shape=(np.int64(4), 5)).downsampled(np.int64(2)).shape == (2, 2)
    assert replace(CAMERA, sdd_mm=1e7, principal_point_px=(-1e5, 1e5)).sdd_mm == 1e7


@pytest.mark.parametrize("factor", [0, -1, 2.5, 2.0, True])
def test_blocks_of_no_whole_number_of_pixels_are_refused(factor):
    with pytest.raises(InputError, match="a whole number of pixels"):
        CAMERA.downsampled(factor)


def test_blocks_larger_than_the_detector_are_refused():
    assert CAMERA.downsampled(120).shape == (1, 1)
    with pytest.raises(InputError, match="no block of 121 × 121 pixels"):
        CAMERA.downsampled(121)


def test_a_changed_camera_and_its_coarser_grid_change_alike() -> None:
    camera = centred_camera(1000.0, (0.2, 0.4), (100, 80))
    change = CameraChange(1.03, (1.2, -0.6))
    changed = camera.changed(change)
    assert changed.sdd_mm == pytest.approx(1030)
    assert changed.principal_point_px == pytest.approx((39.5 + 3.0, 49.5 - 3.0))
    there, here = camera.downsampled(2).changed(change), changed.downsampled(2)
    assert there.principal_point_px == pytest.approx(here.principal_point_px)
    assert there.sdd_mm == here.sdd_mm
    back = changed.changed(CameraChange(1 / 1.03, (-1.2, 0.6)))
    assert back.principal_point_px == pytest.approx(camera.principal_point_px)
    assert change.then(CameraChange(1.03, (0.0, 1.0))) == CameraChange(1.03**2, (1.2, 0.4))
