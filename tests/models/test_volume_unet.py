"""The network for volumes: blocks become channels and back, and its settings are checked."""

import pytest
import torch

from models.volume_unet import VolumeUNetSettings, _blocks_to_channels, _channels_to_blocks


def test_blocks_of_two_voxels_become_channels_and_come_back() -> None:
    volume = torch.arange(4 * 6 * 8, dtype=torch.float32).reshape(1, 1, 4, 6, 8)
    channels = _blocks_to_channels(volume)
    assert channels.shape == (1, 8, 2, 3, 4)
    assert channels[0, :, 1, 2, 3].tolist() == volume[0, 0, 2:4, 4:6, 6:8].flatten().tolist()
    assert torch.equal(_channels_to_blocks(channels), volume)


def test_logits_lie_on_the_voxels_of_the_input() -> None:
    settings = VolumeUNetSettings(classes=3, channels=(8, 16))
    assert settings.multiple == 4
    network = settings.build().eval()
    with torch.inference_mode():
        assert network(torch.randn(1, 1, 8, 4, 12)).shape == (1, 3, 8, 4, 12)


@pytest.mark.parametrize("wrong", [{"channels": ()}, {"channels": (12,)}, {"classes": 1}, {"voxel_mm": 0.0}])
def test_settings_that_make_no_network_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        VolumeUNetSettings(**{"classes": 3, **wrong})  # type: ignore[arg-type]
