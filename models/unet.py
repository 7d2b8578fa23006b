"""A compact multi-task U-Net: which bone each pixel shows, and where the 14 landmarks of the hip are.

After Ronneberger et al., MICCAI 2015, and the two-headed network of Grupp et al., IJCARS 15, 2020, made small enough to
train on a CPU: the image enters as 4 × 4 patches turned into channels and the heads double the resolution again
(sub-pixel convolution, Shi et al., CVPR 2016). A landmark that is not in the image has a class of its own beside the
pixels, like the dustbin of SuperPoint (DeTone et al., CVPRW 2018).
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class UNetConfig:
    """Everything that fixes the network's shape."""

    architecture: Literal["compact", "grupp2020"] = "compact"  # this module's, or `models.reference`
    channels: tuple[int, ...] = (64, 96, 160, 256)  # per level, at 1/4, 1/8, 1/16, 1/32 of the input
    convolutions: tuple[int, ...] = (2, 2, 3, 3)  # per level of the encoder
    residual: tuple[int, ...] = ()  # residual blocks after those, per level; none by default
    patch: int = 4  # pixels per side that become channels
    classes: int = 7  # background, hip bones left and right, vertebrae, sacrum, femora left and right
    landmarks: int = 14


class Prediction(NamedTuple):
    """Logits on a grid of half the input's resolution; its pixel i covers the input's pixels 2 i and 2 i + 1."""

    segmentation: Tensor  # (B, classes, H / 2, W / 2)
    heatmaps: Tensor  # (B, landmarks, H / 2, W / 2)
    absence: Tensor  # (B, landmarks): competes with the pixels of the heat map in one softmax


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _Residual(nn.Module):
    """Two convolutions beside a shortcut, as in He et al., ECCV 2016.

    The last scale starts at zero, so that a network may be deepened without changing what it has learned.
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
    """Takes images (B, 1, H, W) of mean 0 and deviation 1 each; H and W are multiples of patch · 2^(levels − 1)."""

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.channels
        inputs = (config.patch**2, *widths[:-1])
        blocks = config.residual or (0,) * len(widths)
        sizes = zip(inputs, widths, config.convolutions, blocks, strict=True)
        self.encoder = nn.ModuleList(_level(*size) for size in sizes)
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1, bias=False) for a, b in pairwise(widths))
        self.decoder = nn.ModuleList(_convolution(2 * a, a) for a in widths[:-1])
        zoom = (config.patch // 2) ** 2
        self.segmentation = nn.Conv2d(widths[0], config.classes * zoom, 1)
        self.hidden = nn.Conv2d(widths[0] + config.classes * zoom, widths[0], 1)
        self.heatmaps = nn.Conv2d(widths[0], config.landmarks * zoom, 1)
        self.absence = nn.Linear(widths[-1], config.landmarks)
        # Starts as likely as all pixels of a 96 × 96 heat map together.
        nn.init.constant_(self.absence.bias, 2 * math.log(96))

    def forward(self, image: Tensor) -> Prediction:
        features = F.pixel_unshuffle(image, self.config.patch).contiguous(memory_format=torch.channels_last)
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
        zoom = self.config.patch // 2
        return Prediction(F.pixel_shuffle(segmentation, zoom), F.pixel_shuffle(self.heatmaps(hidden), zoom), absence)
