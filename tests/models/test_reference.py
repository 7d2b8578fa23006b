"""The paper's network: its size to the parameter, and that it takes the place of the compact one."""

from pathlib import Path

import torch
from torch import nn
from torch.testing import assert_close

from models.reference import ReferenceUNet
from models.unet import UNetConfig
from models.weights import load_weights, save_weights

SMALL = UNetConfig(architecture="grupp2020", channels=(4, 8, 16))


def test_as_many_parameters_as_published() -> None:
    """Counted from the authors' code: encoder 20,975,680, decoder 12,927,744, heads 1,337."""
    with torch.device("meta"):
        network = ReferenceUNet(UNetConfig(architecture="grupp2020", channels=(32, 64, 128, 256, 512, 1024)))

    def count(*parts: nn.Module) -> int:
        return sum(parameter.numel() for part in parts for parameter in part.parameters())

    assert count(network.encoder, network.down) == 20_975_680
    assert count(network.up, network.decoder) == 12_927_744
    assert count(network.segmentation, network.heatmaps) == 1_337


def test_answers_as_the_compact_network_does(tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = ReferenceUNet(SMALL).eval()
    image = torch.randn(2, 1, 64, 96)
    prediction = network(image)
    assert prediction.segmentation.shape == (2, 7, 32, 48)
    assert prediction.heatmaps.shape == (2, 14, 32, 48)
    assert prediction.absence.shape == (2, 14)
    save_weights(tmp_path / "reference.safetensors", network, {})
    again = load_weights(tmp_path / "reference.safetensors")
    assert isinstance(again, ReferenceUNet)
    assert_close(again(image).heatmaps, prediction.heatmaps, atol=0, rtol=0)
