"""Variants of an image: truth and image stay together."""

import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.geometry import load_carm, project_points, transform_points
from training.measure import LabelledImage
from training.robustness import cropped_to_one_hip, inverted, turned

CAMERA = load_carm("cios_fusion").camera.downsampled(8)
POINTS = torch.tensor(
    [[x, y, z] for x in (-90.0, -20, 10, 40, 60, 80, 100) for y, z in ((-20.0, -50), (30, 40))]
).double()
TRUTH = torch.tensor([[1.0, 0, 0, 5], [0, 0, -1, 9], [0, 1, 0, 760], [0, 0, 0, 1]]).double()


@pytest.fixture
def image() -> LabelledImage:
    pixels = project_points(CAMERA, transform_points(TRUTH, POINTS))
    labels = torch.zeros(192, 192, dtype=torch.uint8)
    labels[:, :60] = 3
    attenuation = torch.linspace(1, 4, 192).expand(192, 192)
    return LabelledImage("one", attenuation, CAMERA, pixels, labels, torch.ones(14, dtype=torch.bool), POINTS, TRUTH)


def test_a_turn_takes_the_pose_along(image: LabelledImage) -> None:
    other = turned(image)
    assert other.camera_from_lps is not None
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
