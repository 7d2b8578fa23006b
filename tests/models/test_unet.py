"""The network and its weights on disk."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.testing import assert_close

from models.unet import UNet, UNetConfig
from models.weights import SHIPPED_WEIGHTS, load_weights, save_weights

TINY = UNetConfig(channels=(8, 12, 16), convolutions=(1, 1, 1))


@pytest.fixture
def network() -> UNet:
    torch.manual_seed(3)
    return UNet(TINY).eval()


def test_outputs_have_half_the_resolution(network: UNet) -> None:
    prediction = network(torch.randn(2, 1, 64, 96))
    assert prediction.segmentation.shape == (2, 7, 32, 48)
    assert prediction.heatmaps.shape == (2, 14, 32, 48)
    assert prediction.absence.shape == (2, 14)


def test_the_output_lies_centred_on_the_input() -> None:
    """Mirroring the weights and the image mirrors the output, so that no half-pixel shift hides in the network."""
    torch.manual_seed(1)
    network = UNet(TINY).eval()
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


def test_weights_round_trip(network: UNet, tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    save_weights(path, network, {"seed": "3"})
    again = load_weights(path)
    assert again.config == TINY
    assert not again.training
    image = torch.randn(1, 1, 64, 64)
    assert_close(again(image).heatmaps, network(image).heatmaps, atol=0, rtol=0)


def test_weights_that_do_not_fit(network: UNet, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_weights(tmp_path / "missing.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="no `config`"):
        load_weights(tmp_path / "other.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "odd.safetensors", metadata={"config": json.dumps({"depth": 3})})
    with pytest.raises(ValueError, match="do not fit"):
        load_weights(tmp_path / "odd.safetensors")


def test_the_shipped_weights() -> None:
    network = load_weights()
    assert network.config.landmarks == 14
    assert network.config.classes == 7
    shipped = Path(__file__).resolve().parents[2] / "models" / "weights" / SHIPPED_WEIGHTS
    assert shipped.stat().st_size <= 20e6
