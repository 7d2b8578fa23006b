"""Augmenting an image and undoing it on the prediction, against a network that only copies its image."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import LandmarkNetwork, decode_heatmaps
from femoreg_torch.detect.tta import AUGMENTATIONS, PLAIN, Augmentation, predict
from models.protocols import Prediction

LEFT, RIGHT = torch.tensor([66.3, 31.2]), torch.tensor([21.8, 52.4])  # of the patient, on the 96 × 96 output
SIDES = {name: name.endswith("-l") for name in HIP.landmark_names}


def spots() -> Tensor:
    """A patient with a bright spot on the left side, which is the image's right one, and one on the right."""
    axis = torch.arange(192).float()
    image = torch.zeros(192, 192)
    for column, row in (LEFT, RIGHT):
        across, down = (axis - (2 * column + 0.5)) ** 2, (axis - (2 * row + 0.5)) ** 2
        image += torch.exp(-(across + down[:, None]) / (2 * 4.0**2))
    return image


class Copying(nn.Module):
    """Every left landmark is the spot in the right half, every right one that in the left half; so are the hips."""

    def forward(self, images: Tensor) -> Prediction:
        small = F.avg_pool2d(images, 2).clamp_min(1e-4).log() * 4
        column = torch.arange(96)
        left, right = (small.where(side, torch.tensor(-40.0)) for side in (column >= 48, column < 48))
        heatmaps = torch.cat([left if is_left else right for is_left in SIDES.values()], 1)
        empty = torch.full_like(small, -20)
        bones = {"hip_left": left, "hip_right": right, "femur_left": left - 1, "femur_right": right - 1}
        classes = torch.cat([empty + 5, *(bones.get(name, empty) for name in HIP.bone_names)], 1)
        return Prediction(classes, heatmaps, torch.full((len(images), len(SIDES)), -10.0))


NETWORK = LandmarkNetwork(Copying())


@pytest.mark.parametrize(
    "added", [(), AUGMENTATIONS[1:], (Augmentation(True, 8, 1.2, (0.04, -0.03)),), (Augmentation(zoom=0.8),)]
)
def test_every_augmentation_is_undone(added: tuple[Augmentation, ...]) -> None:
    prediction = predict(NETWORK, spots(), (*PLAIN, *added))
    positions, confidence = decode_heatmaps(prediction.heatmaps, prediction.absence)
    truth = torch.stack([LEFT if is_left else RIGHT for is_left in SIDES.values()])
    assert_close(positions.float(), truth, atol=0.08, rtol=0)
    assert confidence.min() > 0.95
    labels = prediction.segmentation.argmax(0)
    for bone, (column, row) in {
        "hip_left": LEFT.round().int().tolist(),
        "hip_right": RIGHT.round().int().tolist(),
    }.items():
        assert labels[row, column] == HIP.classes([bone])[0]


def test_a_quarter_turn_takes_the_right_of_the_image_to_its_bottom() -> None:
    """Image axes: columns to the right, rows down, so that a positive angle turns the picture against the clock."""
    middle_right = torch.tensor([1.0, 0.0])
    affine = Augmentation(turn_deg=90).augmented_from_image()
    assert_close(affine[:, :2] @ middle_right + affine[:, 2], torch.tensor([0.0, -1.0]), atol=1e-6, rtol=0)
    shifted = Augmentation(shift=(0.25, 0.0)).image_from_augmented()
    assert_close(shifted[:, 2], torch.tensor([0.5, 0.0]))  # a quarter of the width is half of −1 … 1


@pytest.mark.parametrize("augmentation", [*AUGMENTATIONS, Augmentation(True, 20, 1.3, (0.1, -0.2))])
def test_there_and_back(augmentation: Augmentation) -> None:
    there, back = (
        torch.cat([affine, torch.tensor([[0.0, 0, 1]])])
        for affine in (augmentation.image_from_augmented(), augmentation.augmented_from_image())
    )
    assert_close(back @ there, torch.eye(3), atol=1e-6, rtol=0)


def test_zooming_leaves_the_probability_of_absence_alone() -> None:
    plain = predict(NETWORK, spots(), PLAIN)
    mean = predict(NETWORK, spots(), (Augmentation(), Augmentation(zoom=1.1), Augmentation(zoom=0.9)))
    for prediction in (plain, mean):
        total = torch.logaddexp(prediction.heatmaps.flatten(1).logsumexp(1), prediction.absence)
        assert_close((prediction.absence - total).exp(), plain.absence.exp(), atol=2e-3, rtol=0)
