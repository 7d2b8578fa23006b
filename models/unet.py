"""A compact multi-task U-Net: which bone each pixel shows, and where the landmarks are.

After Ronneberger et al., MICCAI 2015, and the two-headed network of Grupp et al., IJCARS 15, 2020, made small enough to
train on a CPU: the image enters as 4 × 4 patches turned into channels and the heads double the resolution again
(sub-pixel convolution, Shi et al., CVPR 2016). A landmark that is not in the image has a class of its own beside the
pixels, like the dustbin of SuperPoint (DeTone et al., CVPRW 2018).
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.protocols import Prediction


@dataclass(frozen=True)
class UNetSettings:
    """Everything that fixes the network's shape."""

    classes: int  # of the segmentation, the background included
    landmarks: int
    channels: tuple[int, ...] = (64, 96, 160, 256)  # per level, at 1/4, 1/8, 1/16, 1/32 of the input
    convolutions: tuple[int, ...] = (2, 2, 3, 3)  # per level of the encoder
    residual: tuple[int, ...] = ()  # residual blocks after those, per level; none by default
    patch: int = 4  # pixels per side that become channels

    def __post_init__(self) -> None:
        levels = len(self.channels)
        if not (1 <= levels <= 8 and all(1 <= n <= 2048 for n in self.channels)):
            raise ValueError(f"channels: 1 to 8 numbers of 1 to 2048 were expected, found {len(self.channels)}.")
        if len(self.convolutions) != levels or not all(1 <= n <= 32 for n in self.convolutions):
            raise ValueError(f"convolutions: {levels} numbers of 1 to 32 were expected, as there are channels.")
        if self.residual and (len(self.residual) != levels or not all(0 <= n <= 32 for n in self.residual)):
            raise ValueError(f"residual: none, or {levels} numbers of 0 to 32 were expected, as there are channels.")
        if not (1 <= self.patch <= 64 and 1 <= self.classes <= 1000 and 1 <= self.landmarks <= 1000):
            raise ValueError("patch: 1 to 64, classes and landmarks: 1 to 1000 were expected.")

    def build(self) -> "UNet":
        """A new network with random weights."""
        return UNet(self)


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _Residual(nn.Module):
    """Two convolutions beside an identity shortcut, as in He et al., ECCV 2016.

    The last batch normalisation starts with scale zero, so that the block starts as the identity: a trained network can
    be deepened without changing its function.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        last = nn.BatchNorm2d(width)
        nn.init.zeros_(last.weight)
        self.body = nn.Sequential(_convolution(width, width), nn.Conv2d(width, width, 3, padding=1, bias=False), last)

    def forward(self, features: Tensor) -> Tensor:
        return F.relu(features + self.body(features))


def _level(inputs: int, outputs: int, convolutions: int, residual: int) -> nn.Sequential:
    return nn.Sequential(
        _convolution(inputs, outputs),
        *(_convolution(outputs, outputs) for _ in range(convolutions - 1)),
        *(_Residual(outputs) for _ in range(residual)),
    )


class UNet(nn.Module):
    """Maps images (B, 1, H, W), H and W multiples of patch · 2^(levels − 1), to a `Prediction`."""

    def __init__(self, settings: UNetSettings) -> None:
        super().__init__()
        self.patch = settings.patch
        widths = settings.channels
        inputs = (settings.patch**2, *widths[:-1])
        blocks = settings.residual or (0,) * len(widths)
        sizes = zip(inputs, widths, settings.convolutions, blocks, strict=True)
        self.encoder = nn.ModuleList(_level(*size) for size in sizes)
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1, bias=False) for a, b in pairwise(widths))
        self.decoder = nn.ModuleList(_convolution(2 * a, a) for a in widths[:-1])
        zoom = (settings.patch // 2) ** 2
        self.segmentation = nn.Conv2d(widths[0], settings.classes * zoom, 1)
        self.hidden = nn.Conv2d(widths[0] + settings.classes * zoom, widths[0], 1)
        self.heatmaps = nn.Conv2d(widths[0], settings.landmarks * zoom, 1)
        self.absence = nn.Linear(widths[-1], settings.landmarks)
        # at the start, absence is as probable as all pixels of a 96 × 96 heat map together
        nn.init.constant_(self.absence.bias, 2 * math.log(96))

    def forward(self, image: Tensor) -> Prediction:
        features = F.pixel_unshuffle(image, self.patch).contiguous(memory_format=torch.channels_last)
        skips = []
        for depth, level in enumerate(self.encoder):
            features = level(F.max_pool2d(features, 2) if depth else features)
            skips.append(features)
        absence = self.absence(skips.pop().mean((2, 3)))
        for narrow, decode in zip(reversed(self.narrow), reversed(self.decoder), strict=True):
            wide = F.interpolate(narrow(features), scale_factor=2.0, mode="nearest")
            features = decode(torch.cat([wide, skips.pop()], 1))
        segmentation = self.segmentation(features)
        hidden = F.relu(self.hidden(torch.cat([features, segmentation], 1)))
        zoom = self.patch // 2
        return Prediction(F.pixel_shuffle(segmentation, zoom), F.pixel_shuffle(self.heatmaps(hidden), zoom), absence)
