"""Losses of the two tasks; each is zero for a perfect prediction."""

import torch
from torch import Tensor
from torch.nn import functional as F

from models.unet import Prediction


def dice_loss(probabilities: Tensor, labels: Tensor, epsilon: float = 1.0) -> Tensor:
    """Mean over images and classes of 1 − (2 Σ p t + ε) / (Σ p² + Σ t² + ε), with t the one-hot `labels`.

    `probabilities` (B, C, H, W) after the softmax, `labels` (B, H, W) integer. Squared denominators as in Milletari et
    al., 3DV 2016. ε stands with the same sign in both places, so that a class that is absent and predicted empty costs
    nothing, while predicting it somewhere does; it is in pixels.
    """
    truth = F.one_hot(labels.long(), probabilities.shape[1]).movedim(-1, 1).to(probabilities.dtype)
    overlap = (probabilities * truth).sum((2, 3))
    total = (probabilities**2).sum((2, 3)) + truth.sum((2, 3))
    return (1 - (2 * overlap + epsilon) / (total + epsilon)).mean()


def _peaks(pixels: Tensor, visible: Tensor, shape: tuple[int, int], sigma_px: float) -> tuple[Tensor, Tensor]:
    """Gaussians of sum 1 along rows (B, L, H) and columns (B, L, W); their product is a landmark's peak.

    The peak of a landmark that is not visible stands in the corner, so that its values stay finite.
    """
    column, row = pixels.where(visible[..., None], torch.zeros_like(pixels)).unbind(-1)
    down = torch.arange(shape[0], dtype=pixels.dtype, device=pixels.device) - row[..., None]
    along = torch.arange(shape[1], dtype=pixels.dtype, device=pixels.device) - column[..., None]
    return (-0.5 * (down / sigma_px) ** 2).softmax(-1), (-0.5 * (along / sigma_px) ** 2).softmax(-1)


def landmark_target(pixels: Tensor, visible: Tensor, shape: tuple[int, int], sigma_px: float) -> Tensor:
    """Truth as a distribution (B, L, H · W + 1) over the pixels of the heat map and "not in the image".

    `pixels` (B, L, 2) are (column, row) on the heat map's grid, `visible` (B, L) bool. A Gaussian of `sigma_px` about a
    visible landmark, cut off at the image's border and of sum 1; the last entry is 1 for the others.
    """
    down, along = _peaks(pixels, visible, shape, sigma_px)
    gaussian = (down[..., :, None] * along[..., None, :]).flatten(2)
    inside = visible[..., None].to(pixels.dtype)
    return torch.cat([gaussian * inside, 1 - inside], -1)


def landmark_log_probabilities(heatmaps: Tensor, absence: Tensor) -> Tensor:
    """Logarithm of the network's own distribution (B, L, H · W + 1), the last entry being "not in the image"."""
    return F.log_softmax(torch.cat([heatmaps.flatten(2), absence[..., None]], -1), -1)


def landmark_loss(heatmaps: Tensor, absence: Tensor, pixels: Tensor, visible: Tensor, sigma_px: float) -> Tensor:
    """Mean over images and landmarks of the Kullback-Leibler divergence from target to prediction, in nats.

    Visibility is learned with the place: a landmark outside of the image has all its mass on "not in the image".
    """
    heatmaps, absence = heatmaps.float(), absence.float()
    down, along = _peaks(pixels, visible, (heatmaps.shape[2], heatmaps.shape[3]), sigma_px)
    # The target is the product of two vectors, so its expectation of the logits and its entropy need no map of its own.
    expected = ((heatmaps @ along[..., None])[..., 0] * down).sum(-1)
    entropy = -torch.xlogy(down, down).sum(-1) - torch.xlogy(along, along).sum(-1)
    normaliser = torch.logaddexp(heatmaps.flatten(2).logsumexp(-1), absence)
    return (normaliser - torch.where(visible, expected + entropy, absence)).mean()


def segmentation_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Dice loss plus cross-entropy of class logits (B, C, H, W) against `labels` (B, H, W)."""
    logarithms = logits.float().log_softmax(1)
    return dice_loss(logarithms.exp(), labels) + F.nll_loss(logarithms, labels.long())


def multi_task_loss(
    prediction: Prediction, labels: Tensor, pixels: Tensor, visible: Tensor, sigma_px: float, landmark_weight: float
) -> dict[str, Tensor]:
    """`segmentation`, `landmarks`, and their weighted sum `loss`; `labels` and `pixels` on the prediction's grid.

    Computed in float32, whatever precision the network ran in.
    """
    with torch.autocast(labels.device.type, enabled=False):
        segmentation = segmentation_loss(prediction.segmentation, labels)
        landmarks = landmark_loss(prediction.heatmaps, prediction.absence, pixels, visible, sigma_px)
    return {
        "loss": segmentation + landmark_weight * landmarks,
        "segmentation": segmentation,
        "landmarks": landmarks,
    }
