"""The measurement against a network that finds what was planted, and intervals against hand-made readings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor, nn

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import LandmarkNetwork
from femoreg_torch.detect.grid import NETWORK_PIXEL_MM
from femoreg_torch.detect.tta import PLAIN
from femoreg_torch.geometry import load_carm, project_points, transform_points
from models.protocols import Prediction
from training.accuracy import summarise
from training.augmentation import inside
from training.labelled import LabelledImage
from training.measure import Reading, read_images

CAMERA = load_carm("cios_fusion").camera.downsampled(8)
LANDMARKS, BONES = len(HIP.landmarks), len(HIP.bones)
(FEMUR,) = HIP.classes(["femur_left"])


class Planted(nn.Module):
    """Answers image after image with what was planted, and finds no landmark in one that is turned or inverted."""

    def __init__(self, pixels: Tensor, visible: Tensor, labels: Tensor) -> None:
        super().__init__()
        axis = torch.arange(96.0)
        squares = (axis - pixels[..., :1])[..., None, :] ** 2 + (axis - pixels[..., 1:])[..., :, None] ** 2
        self.heatmaps = (-squares / (2 * 1.5**2)).flatten(2).log_softmax(2).view(squares.shape)
        self.absence = torch.where(visible, -25.0, 25.0)
        self.segmentation = nn.functional.one_hot(labels.long(), 1 + BONES).movedim(-1, 1).float() * 20

    def forward(self, images: Tensor) -> Prediction:
        n = int(images[0, 0, 0, 0] < images[0, 0, 0, -1])  # which of two images
        upright = images[0, 0, :20].mean() > images[0, 0, -20:].mean()
        absence = self.absence[n] if upright else self.absence[n] + 50
        return Prediction(self.segmentation[n : n + 1], self.heatmaps[n : n + 1], absence[None])


def images() -> Tensor:
    """Two images, bright above, that rise to the left and to the right, with a bright bone at the left edge."""
    row, column = torch.meshgrid(torch.arange(192.0), torch.arange(192.0), indexing="ij")
    bone = 200 * ((row >= 10) & (row < 30) & (column < 20))
    return torch.stack([-3 * row - column, -3 * row + column]) + bone


def planting(pixels: Tensor, visible: Tensor, labels: Tensor) -> LandmarkNetwork:
    return LandmarkNetwork(Planted(pixels, visible, labels))


POINTS = torch.tensor(
    [
        [side * x, y, z]
        for x, y, z in [
            [90.0, -10, -80], [75, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120],
            [85, -75, -45],
        ]
        for side in (1, -1)
    ]
).double()  # fmt: skip
TRUTH = torch.tensor([[1.0, 0, 0, 20], [0, 0, -1, -60], [0, 1, 0, 760], [0, 0, 0, 1]]).double()


def test_errors_misses_and_false_finds_are_counted() -> None:
    pixels = torch.full((2, LANDMARKS, 2), 40.0)  # on the output's grid
    visible = torch.ones(2, LANDMARKS, dtype=torch.bool)
    visible[:, 0] = False
    labels = torch.zeros(2, 96, 96, dtype=torch.uint8)
    labels[:, :10, :10] = FEMUR
    found = visible.clone()
    found[0, 0] = True  # one of the two that are not there
    found[:, -1] = False  # two of those that are
    network = planting(pixels + torch.tensor([2.0, 0.0]), found, labels.roll(5, 1))
    there = 2 * pixels + 0.5
    labelled = [
        LabelledImage("one", images()[n], CAMERA, there[n], labels[n], visible[n], POINTS, TRUTH) for n in range(2)
    ]
    accuracy = summarise(read_images(network, labelled, PLAIN))
    value = {name: measure.value for name, measure in accuracy.measures.items()}
    for name in ("median_mm", "mean_mm", "p90_mm"):
        assert value[name] == pytest.approx(2 * 2 * NETWORK_PIXEL_MM, abs=0.05)
    assert value["recall"] == pytest.approx((LANDMARKS - 2) / (LANDMARKS - 1))
    assert value["false_positives"] == 0.5
    assert value["gross"] == 0
    assert value["dice_femur_left"] == pytest.approx(0.5)
    assert np.isnan(value["dice_sacrum"])
    assert value["pose_refused"] == 1  # all landmarks in one place fix no pose
    gsn = accuracy.landmarks["GSN-r"]
    assert (gsn.mean_mm, gsn.median_mm) == pytest.approx((6.208, 6.208), abs=0.05)
    assert (gsn.recall, gsn.in_image) == (1.0, 2)
    assert (accuracy.landmarks["ASIS-r"].recall, accuracy.landmarks["ASIS-r"].in_image) == (0, 2)


def test_poses_are_judged() -> None:
    pixels = project_points(CAMERA, transform_points(TRUTH, POINTS))
    visible = inside(pixels, CAMERA.shape)
    network = planting(((pixels - 0.5) / 2).float().expand(2, -1, -1), visible.expand(2, -1), torch.zeros(2, 96, 96))
    image = LabelledImage("one", images()[0], CAMERA, pixels, torch.zeros(96, 96), visible, POINTS, TRUTH)
    moved = TRUTH.clone()
    moved[2, 3] += 70
    readings = read_images(network, [image, replace(image, camera_from_lps=moved)], PLAIN)
    assert readings[0].pose_error[0] < 1
    assert readings[1].pose_error[2] == pytest.approx(70, abs=5)
    value = summarise(readings).measures
    assert (value["pose_fair"].value, value["pose_coarse"].value, value["pose_refused"].value) == (0.5, 1.0, 0.0)
    hidden = replace(image, visible=visible & (torch.arange(LANDMARKS) < 5))
    assert not read_images(network, [hidden], PLAIN)[0].asked


def reading(patient: str, error_mm: float) -> Reading:
    yes = np.ones(LANDMARKS, dtype=bool)
    error, certain = np.full(LANDMARKS, error_mm), np.ones(LANDMARKS)
    return Reading(patient, error, yes, yes, certain, np.ones((BONES, 2)), False, False, np.full(3, np.nan))


def test_the_interval_is_over_patients_not_over_images() -> None:
    """Two patients, a thousand images: half of all redraws hold one patient only."""
    accuracy = summarise([reading("a", 1.0)] * 500 + [reading("b", 3.0)] * 500)
    mean = accuracy.measures["mean_mm"]
    assert (mean.value, mean.low, mean.high) == (2.0, 1.0, 3.0)
    assert (accuracy.images, accuracy.patients) == (1000, 2)
    alone = summarise([reading("a", 1.0)] * 10).measures["mean_mm"]
    assert alone.low == alone.high == 1.0


def test_the_interval_is_that_of_scipy() -> None:
    """Of the mean of 12 patients with an image each, where scipy's percentile bootstrap can be asked as well."""
    errors = np.random.default_rng(1).gamma(2.0, 2.0, 12)
    mean = summarise([reading(f"{n:02d}", error) for n, error in enumerate(errors)]).measures["mean_mm"]
    theirs = stats.bootstrap((errors,), np.mean, n_resamples=20_000, method="percentile", rng=2).confidence_interval
    assert (mean.low, mean.high) == pytest.approx((theirs.low, theirs.high), abs=0.1 * errors.std())
