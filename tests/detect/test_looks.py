"""Moving an image and undoing it on what the network says, against a network that only copies its image."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.testing import assert_close

from femoreg_torch.detect import decode_heatmaps
from femoreg_torch.detect.looks import LOOKS, PLAIN, Look, read_image
from models.unet import Prediction

LEFT, RIGHT = torch.tensor([66.3, 31.2]), torch.tensor([21.8, 52.4])  # of the patient, on the 96 × 96 output


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
        heatmaps = torch.cat([left, right], 1).repeat(1, 7, 1, 1)
        empty = torch.full_like(small, -20)
        bones = torch.cat([empty + 5, left, right, empty, empty, left - 1, right - 1], 1)
        return Prediction(bones, heatmaps, torch.full((len(images), 14), -10.0))


@pytest.mark.parametrize("moved", [(), LOOKS[1:], (Look(True, 8, 1.2, (0.04, -0.03)),), (Look(zoom=0.8),)])
def test_every_look_is_undone(moved: tuple[Look, ...]) -> None:
    looks = (*PLAIN, *moved)
    reading = read_image(Copying(), spots(), looks)
    positions, confidence = decode_heatmaps(reading.heatmaps, reading.absence)
    assert_close(positions[0::2].float(), LEFT.expand(7, 2), atol=0.08, rtol=0)
    assert_close(positions[1::2].float(), RIGHT.expand(7, 2), atol=0.08, rtol=0)
    assert confidence.min() > 0.95
    labels = reading.segmentation.argmax(0)
    for label, (column, row) in {1: LEFT.round().int().tolist(), 2: RIGHT.round().int().tolist()}.items():
        assert labels[row, column] == label


def test_there_and_back() -> None:
    for look in (*LOOKS, Look(True, 20, 1.3, (0.1, -0.2))):
        there, back = (
            torch.cat([m, torch.tensor([[0.0, 0, 1]])]) for m in (look.image_from_look(), look.look_from_image())
        )
        assert_close(back @ there, torch.eye(3), atol=1e-6, rtol=0)


def test_zooming_leaves_the_probability_of_absence_alone() -> None:
    plain = read_image(Copying(), spots(), PLAIN)
    looks = (Look(), Look(zoom=1.1), Look(zoom=0.9))
    mean = read_image(Copying(), spots(), looks)
    for reading in (plain, mean):
        total = torch.logaddexp(reading.heatmaps.flatten(1).logsumexp(1), reading.absence)
        assert_close((reading.absence - total).exp(), plain.absence.exp(), atol=2e-3, rtol=0)
