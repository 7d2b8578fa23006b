"""The compact network: shapes, alignment of output and input, and growth."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from models.unet import UNet, UNetSettings

TINY = UNetSettings(classes=5, landmarks=9, channels=(8, 12, 16), convolutions=(1, 1, 1))


@pytest.fixture
def network() -> UNet:
    torch.manual_seed(3)
    return TINY.build().eval()


def test_outputs_have_half_the_resolution(network: UNet) -> None:
    prediction = network(torch.randn(2, 1, 64, 96))
    assert prediction.segmentation.shape == (2, 5, 32, 48)
    assert prediction.heatmaps.shape == (2, 9, 32, 48)
    assert prediction.absence.shape == (2, 9)


def test_residual_blocks_start_as_the_identity(network: UNet) -> None:
    torch.manual_seed(4)
    deeper = replace(TINY, residual=(1, 0, 2)).build().eval()
    deeper.load_state_dict({**deeper.state_dict(), **network.state_dict()})
    image = torch.randn(1, 1, 64, 64)
    assert len(deeper.state_dict()) > len(network.state_dict())
    assert_close(deeper(image).heatmaps, network(image).heatmaps)


def test_the_output_lies_centred_on_the_input() -> None:
    """Mirroring weights and image mirrors the output: there is no shift by half a pixel in the network."""
    torch.manual_seed(1)
    network = TINY.build().eval()
    image = torch.randn(1, 1, 64, 64)
    with torch.no_grad():
        straight = network(image).segmentation
        for name, weight in network.named_parameters():
            if weight.ndim == 4:
                weight.copy_(weight.flip(-1))
            if name == "encoder.0.0.0.weight":  # its input channels are the 4 × 4 pixels of a patch, row by row
                weight.copy_(weight.view(-1, 4, 4, 3, 3).flip(2).reshape(weight.shape))
        for name in ("segmentation", "heatmaps"):  # their output channels are the 2 × 2 pixels of each class
            head = getattr(network, name)
            count = len(head.weight) // 4
            head.weight.copy_(head.weight.view(count, 2, 2, -1).flip(2).reshape(head.weight.shape))
            head.bias.copy_(head.bias.view(count, 2, 2).flip(2).flatten())
        mirrored = network(image.flip(-1)).segmentation
    assert_close(mirrored.flip(-1), straight, atol=1e-4, rtol=1e-4)
