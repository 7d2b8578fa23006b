"""The network of Grupp et al. (IJCARS 15, 2020) for comparison: a six-level U-Net with residual blocks.

Blocks of two 3 × 3 convolutions, each followed by ReLU and then batch normalisation, beside a 1 × 1 convolution of the
block's input; down by 2 × 2 convolutions of stride 2, up by transposed ones. The landmark head takes the features and
the class logits through two 1 × 1 convolutions with nothing between them. Three things differ, so that it is trained,
decoded and measured as `models.unet` is: logits are averaged over 2 × 2 pixels; heat maps are logits of a distribution;
and that distribution has a learned constant for "not in the image", which the original leaves to a test of the map.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.protocols import Prediction

_HIDDEN = 21  # channels between the landmark head's two convolutions


@dataclass(frozen=True)
class Grupp2020Settings:
    """Everything that fixes the network's shape."""

    classes: int  # of the segmentation, the background included
    landmarks: int
    channels: tuple[int, ...] = (32, 64, 128, 256, 512, 1024)  # per level; by default as published

    def __post_init__(self) -> None:
        if not (1 <= len(self.channels) <= 8 and all(1 <= n <= 2048 for n in self.channels)):
            raise ValueError(f"channels: 1 to 8 numbers of 1 to 2048 were expected, found {len(self.channels)}.")
        if not (1 <= self.classes <= 1000 and 1 <= self.landmarks <= 1000):
            raise ValueError("classes and landmarks: 1 to 1000 were expected.")

    def build(self) -> "Grupp2020":
        """A new network with random weights."""
        return Grupp2020(self)


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        layers = []
        for first in (inputs, outputs):
            layers += [nn.Conv2d(first, outputs, 3, padding=1), nn.ReLU(inplace=True), nn.BatchNorm2d(outputs)]
        self.body = nn.Sequential(*layers)
        self.shortcut = nn.Conv2d(inputs, outputs, 1)

    def forward(self, features: Tensor) -> Tensor:
        return self.body(features) + self.shortcut(features)


class Grupp2020(nn.Module):
    """Maps images (B, 1, H, W), H and W multiples of 2^(levels − 1), to a `Prediction`."""

    def __init__(self, settings: Grupp2020Settings) -> None:
        super().__init__()
        widths = settings.channels
        self.encoder = nn.ModuleList(_Block(*sizes) for sizes in pairwise((1, *widths)))
        self.down = nn.ModuleList(nn.Conv2d(width, width, 2, stride=2) for width in widths[:-1])
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in pairwise(widths))
        self.decoder = nn.ModuleList(_Block(2 * width, width) for width in widths[:-1])
        self.segmentation = nn.Conv2d(widths[0], settings.classes, 1, bias=False)
        self.heatmaps = nn.Sequential(
            nn.Conv2d(widths[0] + settings.classes, _HIDDEN, 1, bias=False),
            nn.Conv2d(_HIDDEN, settings.landmarks, 1, bias=False),
        )
        self.absence = nn.Parameter(torch.zeros(settings.landmarks))

    def forward(self, image: Tensor) -> Prediction:
        skips = []
        features = image
        for depth, block in enumerate(self.encoder):
            features = block(self.down[depth - 1](features) if depth else features)
            skips.append(features)
        features = skips.pop()
        for up, decode in zip(reversed(self.up), reversed(self.decoder), strict=True):
            features = decode(torch.cat([skips.pop(), up(features)], 1))
        segmentation = self.segmentation(features)
        heatmaps = self.heatmaps(torch.cat([features, segmentation], 1))
        absence = self.absence.expand(len(image), -1)
        return Prediction(F.avg_pool2d(segmentation, 2), F.avg_pool2d(heatmaps, 2), absence)
