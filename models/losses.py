"""Losses of the two tasks, segmentation and landmarks; each is zero for a perfect prediction."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from models.protocols import Prediction


@dataclass(frozen=True)
class MultiTaskLoss:
    """Segmentation loss plus `landmark_weight` times landmark loss."""

    sigma_px: float = 1.5  # of the landmarks' target distributions, in pixels of the heat map (3.1 mm)
    landmark_weight: float = 0.5

    def __post_init__(self) -> None:
        if not (0.05 <= self.sigma_px <= 50 and 0 <= self.landmark_weight <= 1000):
            raise ValueError("sigma_px: 0.05 to 50, landmark_weight: 0 to 1000 were expected.")

    def __call__(self, prediction: Prediction, labels: Tensor, pixels: Tensor, visible: Tensor) -> dict[str, Tensor]:
        """`segmentation`, `landmarks` and their weighted sum `loss`, in float32 whatever the network's precision.

        `labels` (B, h, w), `pixels` (B, L, 2) and `visible` (B, L) are on the prediction's grid.
        """
        with torch.autocast(labels.device.type, enabled=False):
            segmentation = segmentation_loss(prediction.segmentation, labels)
            landmarks = landmark_loss(prediction.heatmaps, prediction.absence, pixels, visible, self.sigma_px)
        loss = segmentation + self.landmark_weight * landmarks
        return {"loss": loss, "segmentation": segmentation, "landmarks": landmarks}


def segmentation_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Dice loss plus cross-entropy of class logits (B, C, H, W) against `labels` (B, H, W)."""
    logarithms = logits.float().log_softmax(1)
    return dice_loss(logarithms.exp(), labels) + F.nll_loss(logarithms, labels.long())


def dice_loss(probabilities: Tensor, labels: Tensor, epsilon: float = 1.0) -> Tensor:
    """Mean over images and classes of 1 − (2 Σ p t + ε) / (Σ p² + Σ t² + ε), with t the one-hot `labels`.

    `probabilities` (B, C, H, W) after the softmax, `labels` (B, H, W) integer. Squared denominators as in Milletari et
    al., 3DV 2016. ε, in pixels, stands in numerator and denominator alike: a class that is absent from the truth costs
    nothing where it is not predicted, and the more the more of it is predicted.
    """
    truth = F.one_hot(labels.long(), probabilities.shape[1]).movedim(-1, 1).to(probabilities.dtype)
    overlap = (probabilities * truth).sum((2, 3))
    total = (probabilities**2).sum((2, 3)) + truth.sum((2, 3))
    return (1 - (2 * overlap + epsilon) / (total + epsilon)).mean()


def landmark_loss(heatmaps: Tensor, absence: Tensor, pixels: Tensor, visible: Tensor, sigma_px: float) -> Tensor:
    """Mean over images and landmarks of the Kullback-Leibler divergence from target to prediction, in nats.

    The predicted distribution of a landmark is the softmax over the pixels of its heat map (B, L, H, W) and its
    `absence` (B, L). The target of a visible landmark is a Gaussian of `sigma_px` about `pixels` (B, L, 2) (column,
    row), cut off at the image's border and normalised; that of any other is absence with probability 1.
    """
    heatmaps, absence = heatmaps.float(), absence.float()
    down, along = _target(pixels, visible, (heatmaps.shape[2], heatmaps.shape[3]), sigma_px)
    # The Gaussian is a product of two vectors, so its cross-entropy and its entropy need no map of its own.
    expected = ((heatmaps @ along[..., None])[..., 0] * down).sum(-1)
    entropy = -torch.xlogy(down, down).sum(-1) - torch.xlogy(along, along).sum(-1)
    normaliser = torch.logaddexp(heatmaps.flatten(2).logsumexp(-1), absence)
    return (normaliser - torch.where(visible, expected + entropy, absence)).mean()


def _target(pixels: Tensor, visible: Tensor, shape: tuple[int, int], sigma_px: float) -> tuple[Tensor, Tensor]:
    """Gaussians of sum 1 along rows (B, L, H) and columns (B, L, W); their outer product is a landmark's target.

    For a landmark that is not visible it stands in the corner, so that its values stay finite.
    """
    column, row = pixels.where(visible[..., None], torch.zeros_like(pixels)).unbind(-1)
    down = torch.arange(shape[0], dtype=pixels.dtype, device=pixels.device) - row[..., None]
    along = torch.arange(shape[1], dtype=pixels.dtype, device=pixels.device) - column[..., None]
    return (-0.5 * (down / sigma_px) ** 2).softmax(-1), (-0.5 * (along / sigma_px) ** 2).softmax(-1)
