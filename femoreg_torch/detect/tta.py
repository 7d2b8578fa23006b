"""Test-time augmentation: one image read several times, slightly moved or mirrored, and the predictions averaged.

Each augmentation is undone on the network's log-probabilities, which are then averaged: the geometric mean of the
distributions, in which a place that only one of them holds probable gets little.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.detect.weights import LandmarkNetwork


@dataclass(frozen=True)
class Augmentation:
    """How an image is moved before the network sees it: mirrored, turned and zoomed about its middle, then shifted."""

    mirrored: bool = False
    turn_deg: float = 0.0
    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)  # along columns and rows, in shares of the image's width

    def image_from_augmented(self) -> Tensor:
        """Affine map (2, 3) from places in the moved image to places in the image; −1 … 1 from border to border."""
        c, s = math.cos(math.radians(self.turn_deg)) / self.zoom, math.sin(math.radians(self.turn_deg)) / self.zoom
        side = -1.0 if self.mirrored else 1.0
        return torch.tensor([[side * c, -side * s, 2 * self.shift[0]], [s, c, 2 * self.shift[1]]])

    def augmented_from_image(self) -> Tensor:
        """Affine map (2, 3) from places in the image to places in the moved image."""
        there = self.image_from_augmented()
        linear = torch.linalg.inv(there[:, :2])
        return torch.cat([linear, -linear @ there[:, 2:]], 1)


PLAIN = (Augmentation(),)  # the image as it is, and nothing else
AUGMENTATIONS = (
    Augmentation(),
    Augmentation(mirrored=True),
    Augmentation(turn_deg=3, zoom=1.05, shift=(0.012, -0.008)),
    Augmentation(mirrored=True, turn_deg=-3, zoom=0.95, shift=(-0.008, -0.012)),
    Augmentation(turn_deg=-3, zoom=0.95, shift=(-0.012, 0.008)),
    Augmentation(mirrored=True, turn_deg=3, zoom=1.05, shift=(0.008, 0.012)),
)


@dataclass(frozen=True)
class LogProbabilities:
    """Logarithms of probabilities on the grid of the network's output."""

    segmentation: Tensor  # (C, h, w)
    heatmaps: Tensor  # (L, h, w); with `absence` one distribution per landmark, up to a factor
    absence: Tensor  # (L,)

    def cpu(self) -> "LogProbabilities":
        """The same there."""
        return LogProbabilities(self.segmentation.cpu(), self.heatmaps.cpu(), self.absence.cpu())


@torch.inference_mode()
def predict(network: LandmarkNetwork, image: Tensor, augmentations: tuple[Augmentation, ...]) -> LogProbabilities:
    """The averaged prediction for a normalised `image` (H, W) on the network's grid, where the image is.

    One of the `augmentations` has to leave the image as it is, so that every pixel is seen at least once.
    """
    there = torch.stack([augmentation.image_from_augmented() for augmentation in augmentations]).to(image.device)
    back = torch.stack([augmentation.augmented_from_image() for augmentation in augmentations]).to(image.device)
    grid = F.affine_grid(there, [len(augmentations), 1, *image.shape], align_corners=False)
    moved = F.grid_sample(image.expand(len(augmentations), 1, -1, -1), grid, padding_mode="border", align_corners=False)
    prediction = network.module(moved)
    segmentation = prediction.segmentation.float().log_softmax(1)
    heatmaps, absence = prediction.heatmaps.float(), prediction.absence.float()
    total = torch.logaddexp(heatmaps.flatten(2).logsumexp(-1), absence)
    # a pixel of a magnified image holds less than one of the image itself
    area = torch.linalg.det(back[:, :, :2]).abs().log()
    heatmaps = heatmaps - total[..., None, None] + area[:, None, None, None]
    absence = absence - total
    mirrored = torch.tensor([augmentation.mirrored for augmentation in augmentations]).to(image.device)
    landmarks, classes = list(network.anatomy.mirrored_landmarks), list(network.anatomy.mirrored_classes)
    heatmaps[mirrored], absence[mirrored] = heatmaps[mirrored][:, landmarks], absence[mirrored][:, landmarks]
    segmentation[mirrored] = segmentation[mirrored][:, classes]
    maps = torch.cat([segmentation, heatmaps], 1)
    undone = F.affine_grid(back, list(maps.shape), align_corners=False)
    maps = F.grid_sample(maps, undone, padding_mode="border", align_corners=False)
    seen = (undone.abs() <= 1).all(-1).to(maps.dtype)[:, None]  # what an augmentation cut off has no part in the mean
    maps = (maps * seen).sum(0) / seen.sum(0)
    return LogProbabilities(maps[: len(classes)], maps[len(classes) :], absence.mean(0))
