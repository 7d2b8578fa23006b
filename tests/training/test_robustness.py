"""Altered images: truth and image stay together; start poses are counted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import image_from_network
from femoreg_torch.geometry import centred_camera, load_carm, project_points, transform_points
from training.labelled import LabelledImage
from training.measure import Reading
from training.robustness import Outcomes, cropped_to_one_hip, inverted, outcomes, turned

(VERTEBRAE,) = HIP.classes(["vertebrae"])
CAMERA = load_carm("cios_fusion").camera.downsampled(8)
POINTS = torch.tensor(
    [[x, y, z] for x in (-90.0, -20, 10, 40, 60, 80, 100) for y, z in ((-20.0, -50), (30, 40))]
).double()
TRUTH = torch.tensor([[1.0, 0, 0, 5], [0, 0, -1, 9], [0, 1, 0, 760], [0, 0, 0, 1]]).double()


@pytest.fixture
def image() -> LabelledImage:
    pixels = project_points(CAMERA, transform_points(TRUTH, POINTS))
    labels = torch.zeros(192, 192, dtype=torch.uint8)
    labels[:, :60] = VERTEBRAE
    attenuation = torch.linspace(1, 4, 192).expand(192, 192)
    return LabelledImage(
        "one", attenuation, CAMERA, pixels, labels, torch.ones(len(POINTS), dtype=torch.bool), POINTS, TRUTH
    )


def test_a_turn_takes_the_pose_along(image: LabelledImage) -> None:
    other = turned(image)
    assert_close(project_points(other.camera, transform_points(other.camera_from_lps, POINTS)), other.landmarks)
    assert other.attenuation[0, 0] == image.attenuation[-1, -1]
    assert other.labels[0, 0] == image.labels[-1, -1]


def test_an_inversion_exchanges_dark_and_bright(image: LabelledImage) -> None:
    raw, other = torch.exp(-image.attenuation), torch.exp(-inverted(image).attenuation)
    assert_close(raw + other, (raw.max() + raw.min()).expand(192, 192), atol=2e-3, rtol=0)


def test_a_crop_keeps_the_fuller_side_and_hides_the_rest(image: LabelledImage) -> None:
    other = cropped_to_one_hip(image)
    left_out = image.landmarks[:, 0] < 192 - round(0.55 * 192)
    assert left_out.any()
    assert not left_out.all()
    assert other.visible.equal(~left_out)
    assert (other.attenuation[:, :80] == 4).all()
    assert other.attenuation[:, 100:].equal(image.attenuation[:, 100:])
    assert not other.labels[:, :60].any()


@pytest.mark.parametrize(("size", "pixel_mm"), [(180, 1.552), (1436, 0.194), (384, 0.776), (128, 3.2)])
def test_a_crop_of_an_image_of_any_size(image: LabelledImage, size: int, pixel_mm: float) -> None:
    """Those of the DeepFluoro data set have 180 and 1436 columns, and their labels 192."""
    camera = centred_camera(1020.0, (pixel_mm, pixel_mm), (size, size))
    pixels = project_points(camera, transform_points(TRUTH, POINTS))
    shown = torch.linspace(1, 4, size).expand(size, size)
    labels = torch.full((192, 192), VERTEBRAE, dtype=torch.uint8)
    other = cropped_to_one_hip(replace(image, attenuation=shown, camera=camera, landmarks=pixels, labels=labels))
    first = int(other.labels[0].nonzero()[0])
    low = image_from_network(torch.tensor([first - 0.5, 0.0]).double(), camera)[0].item()
    assert low == pytest.approx(size - round(0.55 * size) - 0.5, abs=0.6 * size / 179)


def test_start_poses_are_good_refused_or_silent_failures() -> None:
    def reading(asked: bool, refused: bool, error: tuple[float, float, float]) -> Reading:
        none = np.zeros(0)
        return Reading("one", none, none > 0, none > 0, none, none, asked, refused, np.array(error))

    missing = (np.nan, np.nan, np.nan)
    readings = [
        reading(False, False, missing),
        reading(True, True, missing),
        reading(True, False, (9.0, 19.0, 99.0)),
        reading(True, False, (1.0, 1.0, 1.0)),
        reading(True, False, (11.0, 1.0, 1.0)),
        reading(True, False, (1.0, 21.0, 1.0)),
        reading(True, False, (1.0, 1.0, 101.0)),
    ]
    assert outcomes(readings) == Outcomes(good=2, refused=1, silent_failures=3)
