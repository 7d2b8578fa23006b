"""The network's grid against the detector it is cut from."""

import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.detect import image_from_network, network_camera, to_network_grid
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera, centred_camera, load_carm, project_points

CAMERA = load_carm("cios_fusion").camera
POINTS = torch.tensor([[0.0, 0, 700], [60, -40, 800], [-90, 30, 650]], dtype=torch.float64)


def test_the_papers_detector_is_averaged_over_8_by_8_blocks() -> None:
    image = torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(1))
    assert_close(to_network_grid(image, CAMERA), downsample(image, 8), atol=2e-5, rtol=0)
    assert network_camera(CAMERA) == CAMERA.downsampled(8)


CAMERAS = [
    CAMERA,
    centred_camera(1020.0, (0.388, 0.388), (768, 768)),
    Camera(980.0, (0.3, 0.25), (1001, 1100), (520.0, 470.0)),
    Camera(1100.0, (2.0, 2.0), (140, 151), (70.0, 66.0)),
    Camera(1200.0, (0.9, 0.8), (444, 520), (255.0, 220.0)),  # larger than the grid
]


def test_a_large_image_is_on_the_grid_as_a_whole() -> None:
    camera = CAMERAS[-1]
    grid = network_camera(camera)
    assert grid.pixel_mm == (520 * 0.8 / 192,) * 2
    corners = image_from_network(torch.tensor([[-0.5, -0.5], [191.5, 191.5]], dtype=torch.float64), camera)
    assert_close(corners[:, 0], torch.tensor([-0.5, 519.5], dtype=torch.float64))
    assert corners[0, 1] < -0.5
    assert corners[1, 1] > 443.5
    barely = centred_camera(1000.0, (0.2, 0.2), (1492, 1492))  # 298.4 mm: as good as what networks were trained on
    assert network_camera(barely).pixel_mm == (1.552, 1.552)


@pytest.mark.parametrize("camera", CAMERAS)
def test_both_cameras_see_a_point_in_the_same_place(camera: Camera) -> None:
    on_grid = project_points(network_camera(camera), POINTS)
    assert_close(image_from_network(on_grid, camera), project_points(camera, POINTS), atol=1e-9, rtol=0)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_blob_stays_where_it_is(camera: Camera) -> None:
    truth = project_points(camera, POINTS[:1])[0]
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in camera.shape)
    down = ((rows - truth[1]) * camera.pixel_mm[0])[:, None] ** 2
    blob = torch.exp(-(down + ((columns - truth[0]) * camera.pixel_mm[1]) ** 2) / (2 * 4.0**2))
    small = to_network_grid(blob.float(), camera).double()
    axis = torch.arange(192, dtype=torch.float64)
    centroid = torch.stack([(small.sum(0) * axis).sum(), (small.sum(1) * axis).sum()]) / small.sum()
    assert_close(
        image_from_network(centroid, camera),
        truth,
        atol=0.05 * network_camera(camera).pixel_mm[0] / camera.pixel_mm[0],
        rtol=0,
    )
