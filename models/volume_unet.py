"""A compact U-Net in three dimensions: which bone each voxel of a CT belongs to.

As `models.unet`, with a third axis: blocks of 2 × 2 × 2 voxels enter as channels, and the head doubles the resolution
again (sub-pixel convolution, Shi et al., CVPR 2016). Group normalisation (Wu and He, ECCV 2018), as volumes are trained
on one at a time.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

_BLOCK = 2  # voxels per side that become channels
_GROUPS = 8


@dataclass(frozen=True)
class VolumeUNetSettings:
    """Everything that fixes the network's shape."""

    classes: int  # the background included
    channels: tuple[int, ...] = (16, 32, 64, 128)  # per level, at 1/2, 1/4, 1/8, 1/16 of the input
    voxel_mm: float = 3.0  # of the volumes that it reads

    def __post_init__(self) -> None:
        if not (1 <= len(self.channels) <= 6 and all(_GROUPS <= n <= 512 and n % _GROUPS == 0 for n in self.channels)):
            raise ValueError(f"channels: 1 to 6 multiples of {_GROUPS} up to 512 were expected, found {self.channels}.")
        if not 0.1 <= self.voxel_mm <= 50:
            raise ValueError(f"voxel_mm: 0.1 to 50 was expected, found {self.voxel_mm}.")
        if not 2 <= self.classes <= 1000:
            raise ValueError(f"classes: 2 to 1000 were expected, found {self.classes}.")

    @property
    def multiple(self) -> int:
        """Sides of the input are multiples of this."""
        return _BLOCK * 2 ** (len(self.channels) - 1)

    def build(self) -> "VolumeUNet":
        """A new network with random weights."""
        return VolumeUNet(self)


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, 3, padding=1, bias=False),
        nn.GroupNorm(_GROUPS, outputs),
        nn.ReLU(inplace=True),
    )


class VolumeUNet(nn.Module):
    """Maps volumes (B, 1, Z, Y, X), sides multiples of `settings.multiple`, to logits (B, classes, Z, Y, X)."""

    def __init__(self, settings: VolumeUNetSettings) -> None:
        super().__init__()
        widths = settings.channels
        inputs = (_BLOCK**3, *widths[:-1])
        self.encoder = nn.ModuleList(
            nn.Sequential(_convolution(a, b), _convolution(b, b)) for a, b in zip(inputs, widths, strict=True)
        )
        self.narrow = nn.ModuleList(nn.Conv3d(b, a, 1, bias=False) for a, b in pairwise(widths))
        self.decoder = nn.ModuleList(_convolution(2 * a, a) for a in widths[:-1])
        self.head = nn.Conv3d(widths[0], settings.classes * _BLOCK**3, 1)
        bias = torch.zeros(settings.classes, _BLOCK**3)
        bias[0] = 3.0  # at the start nearly everything is background, as it will be
        self.head.bias = nn.Parameter(bias.flatten())

    def forward(self, volume: Tensor) -> Tensor:
        features = _blocks_to_channels(volume)
        skips = []
        for depth, level in enumerate(self.encoder):
            features = level(F.max_pool3d(features, 2) if depth else features)
            skips.append(features)
        skips.pop()
        for narrow, decode in zip(reversed(self.narrow), reversed(self.decoder), strict=True):
            wide = F.interpolate(narrow(features), scale_factor=2.0, mode="nearest")
            features = decode(torch.cat([wide, skips.pop()], 1))
        return _channels_to_blocks(self.head(features))


def _blocks_to_channels(volume: Tensor) -> Tensor:
    """(B, 1, Z, Y, X) to (B, 8, Z / 2, Y / 2, X / 2)."""
    b, _, z, y, x = volume.shape
    parts = volume.reshape(b, z // _BLOCK, _BLOCK, y // _BLOCK, _BLOCK, x // _BLOCK, _BLOCK)
    return parts.permute(0, 2, 4, 6, 1, 3, 5).reshape(b, _BLOCK**3, z // _BLOCK, y // _BLOCK, x // _BLOCK)


def _channels_to_blocks(features: Tensor) -> Tensor:
    """(B, C · 8, Z, Y, X) to (B, C, 2 Z, 2 Y, 2 X)."""
    b, c, z, y, x = features.shape
    parts = features.reshape(b, c // _BLOCK**3, _BLOCK, _BLOCK, _BLOCK, z, y, x)
    return parts.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(b, c // _BLOCK**3, _BLOCK * z, _BLOCK * y, _BLOCK * x)
