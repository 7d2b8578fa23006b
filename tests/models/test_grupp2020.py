"""The paper's network: its size to the parameter, and the shapes of its prediction."""

import torch
from torch import nn

from models.grupp2020 import Grupp2020Settings


def test_as_many_parameters_as_published() -> None:
    """Counted from the authors' code: encoder 20,975,680, decoder 12,927,744, heads 1,337."""
    with torch.device("meta"):
        network = Grupp2020Settings(classes=7, landmarks=14).build()

    def count(*parts: nn.Module) -> int:
        return sum(parameter.numel() for part in parts for parameter in part.parameters())

    assert count(network.encoder, network.down) == 20_975_680
    assert count(network.up, network.decoder) == 12_927_744
    assert count(network.segmentation, network.heatmaps) == 1_337


def test_outputs_have_half_the_resolution() -> None:
    prediction = Grupp2020Settings(classes=5, landmarks=9, channels=(4, 8, 16)).build()(torch.randn(2, 1, 64, 96))
    assert prediction.segmentation.shape == (2, 5, 32, 48)
    assert prediction.heatmaps.shape == (2, 9, 32, 48)
    assert prediction.absence.shape == (2, 9)
