"""Losses against values worked out by hand."""

import math

import torch
from torch.nn import functional as F
from torch.testing import assert_close

from models.losses import dice_loss, landmark_loss, landmark_target


def one_hot(labels: torch.Tensor, classes: int) -> torch.Tensor:
    return F.one_hot(labels, classes).movedim(-1, 1).float()


def test_dice_of_a_perfect_prediction_is_zero_also_for_absent_classes() -> None:
    labels = torch.tensor([[[0, 0], [1, 1]]])  # class 2 is absent and predicted empty
    assert_close(dice_loss(one_hot(labels, 3), labels), torch.tensor(0.0))


def test_dice_of_an_absent_class_grows_with_what_is_predicted() -> None:
    labels = torch.zeros(1, 4, 4, dtype=torch.long)
    losses = []
    for predicted in (0.0, 0.1, 0.5):
        probabilities = torch.stack([torch.full((4, 4), 1 - predicted), torch.full((4, 4), predicted)])[None]
        losses.append(dice_loss(probabilities, labels).item())
    assert losses[0] < losses[1] < losses[2]


def test_dice_by_hand() -> None:
    labels = torch.tensor([[[0, 1], [1, 1]]])
    probabilities = torch.tensor([[[[0.5, 0.5], [0.0, 0.0]], [[0.5, 0.5], [1.0, 1.0]]]])
    first = 1 - (2 * 0.5 + 1) / (0.5 + 1 + 1)  # Σ p t = 0.5, Σ p² = 0.5, Σ t² = 1, ε = 1
    second = 1 - (2 * 2.5 + 1) / (2.5 + 3 + 1)
    assert_close(dice_loss(probabilities, labels), torch.tensor((first + second) / 2))


def test_target_is_a_distribution_with_its_mean_on_the_landmark() -> None:
    pixels = torch.tensor([[[12.3, 20.7], [500.0, 3.0], [0.0, 0.0]]])
    target = landmark_target(pixels, torch.tensor([[True, False, True]]), (32, 40), 1.5)[0]
    assert_close(target.sum(1), torch.ones(3))
    assert target[1, -1] == 1
    heatmap = target[0, :-1].view(32, 40)
    assert_close((heatmap.sum(0) * torch.arange(40)).sum(), torch.tensor(12.3), atol=1e-3, rtol=0)
    assert_close((heatmap.sum(1) * torch.arange(32)).sum(), torch.tensor(20.7), atol=1e-3, rtol=0)
    assert target[2, 0] > 0.15  # a landmark in the very corner keeps its whole mass inside


def test_landmark_loss_by_hand() -> None:
    """A flat distribution over n entries: ln n for an absent landmark, less the entropy of the target if seen."""
    pixels, visible = torch.tensor([[[10.0, 10.0]]]), torch.tensor([[True]])
    heatmaps, absence = torch.zeros(1, 1, 24, 24), torch.zeros(1, 1)
    flat = math.log(24 * 24 + 1)
    assert_close(landmark_loss(heatmaps, absence, pixels, ~visible, 1.5).item(), flat, atol=1e-4, rtol=0)
    entropy = math.log(2 * math.pi * math.e * 1.5**2)  # of a 2-D Gaussian, in nats
    assert_close(landmark_loss(heatmaps, absence, pixels, visible, 1.5).item(), flat - entropy, atol=1e-3, rtol=0)


def test_landmark_loss_teaches_absence() -> None:
    heatmaps, absence = torch.zeros(1, 1, 8, 8), torch.zeros(1, 1, requires_grad=True)
    landmark_loss(heatmaps, absence, torch.zeros(1, 1, 2), torch.tensor([[False]]), 1.5).backward()
    assert absence.grad is not None
    assert absence.grad.item() < -0.9


def test_landmark_loss_of_the_target_itself_is_zero() -> None:
    pixels, visible = torch.rand(2, 14, 2) * 30, torch.rand(2, 14) > 0.5
    logits = landmark_target(pixels, visible, (32, 32), 1.5).clamp_min(1e-12).log()
    loss = landmark_loss(logits[..., :-1].view(2, 14, 32, 32), logits[..., -1], pixels, visible, 1.5)
    assert_close(loss, torch.tensor(0.0), atol=1e-4, rtol=0)
