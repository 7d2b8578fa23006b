"""The measurement against a network that says what was planted."""

import torch
from torch import Tensor, nn
from torch.testing import assert_close

from femoreg_torch.detect.grid import NETWORK_PIXEL_MM
from models.losses import landmark_target
from models.unet import Prediction
from training.augmentation import Batch
from training.measure import measure


class Planted(nn.Module):
    def __init__(self, pixels: Tensor, visible: Tensor, labels: Tensor) -> None:
        super().__init__()
        logits = landmark_target(pixels, visible, (96, 96), 1.5).clamp_min(1e-12).log()
        segmentation = nn.functional.one_hot(labels.long(), 7).movedim(-1, 1).float() * 20
        self.prediction = Prediction(segmentation, logits[..., :-1].view(2, 14, 96, 96), logits[..., -1])

    def forward(self, _images: Tensor) -> Prediction:
        return self.prediction


def test_errors_misses_and_false_finds_are_counted() -> None:
    pixels = torch.full((2, 14, 2), 40.0)
    visible = torch.ones(2, 14, dtype=torch.bool)
    visible[:, 0] = False
    labels = torch.zeros(2, 96, 96, dtype=torch.uint8)
    labels[:, :10, :10] = 5
    shifted = pixels + torch.tensor([2.0, 0.0])
    found = visible.clone()
    found[0, 0] = True  # one of the two that are not there
    found[:, 13] = False  # two of the 26 that are
    network = Planted(shifted, found, labels.roll(5, 1))
    accuracy = measure(network, [Batch(torch.zeros(2, 1, 192, 192), labels, pixels, visible)])
    for error in (accuracy.median_mm, accuracy.mean_mm, accuracy.p90_mm, accuracy.median_mm_of[3]):
        assert abs(error - 2 * 2 * NETWORK_PIXEL_MM) < 0.05
    assert_close([accuracy.recall, accuracy.false_share, accuracy.gross_share], [24 / 26, 0.5, 0.0])
    assert_close(accuracy.dice, {5: 0.5})
