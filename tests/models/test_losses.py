"""Losses against values worked out by hand."""

import math

import torch
from torch.nn import functional as F
from torch.testing import assert_close

from models.losses import MultiTaskLoss, dice_loss, landmark_loss
from models.protocols import Prediction


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


def gaussian(pixel: torch.Tensor, shape: tuple[int, int], sigma: float) -> torch.Tensor:
    """Probabilities (H, W) of a Gaussian about `pixel` (column, row), cut off at the border."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in shape)
    density = torch.exp(-((columns - pixel[0]) ** 2 + (rows[:, None] - pixel[1]) ** 2) / (2 * sigma**2))
    return density / density.sum()


def test_landmark_loss_is_the_divergence_from_a_gaussian() -> None:
    """Against the Kullback-Leibler divergence by torch, over all pixels and absence, also in a corner."""
    torch.manual_seed(2)
    shape, sigma = (20, 32), 1.5
    pixels = torch.tensor([[[12.3, 7.7], [0.0, 0.0], [40.0, -3.0]]])
    visible = torch.tensor([[True, True, False]])
    heatmaps, absence = torch.randn(1, 3, *shape), torch.randn(1, 3)
    target = torch.zeros(3, shape[0] * shape[1] + 1, dtype=torch.float64)
    target[0, :-1], target[1, :-1] = (gaussian(pixels[0, n], shape, sigma).flatten() for n in (0, 1))
    target[2, -1] = 1
    predicted = torch.cat([heatmaps.flatten(2), absence[..., None]], -1)[0].double().log_softmax(-1)
    expected = F.kl_div(predicted, target, reduction="sum") / 3
    assert_close(landmark_loss(heatmaps, absence, pixels, visible, sigma), expected.float())


def test_landmark_loss_of_the_target_itself_is_zero() -> None:
    pixels = torch.tensor([[[12.3, 7.7], [3.0, 3.0]]])
    heatmaps = gaussian(pixels[0, 0], (20, 32), 1.5).clamp_min(1e-12).log().float().expand(1, 2, -1, -1)
    absence = torch.tensor([[-30.0, 30.0]])
    loss = landmark_loss(heatmaps, absence, pixels, torch.tensor([[True, False]]), 1.5)
    assert_close(loss, torch.tensor(0.0), atol=1e-4, rtol=0)


def test_the_multi_task_loss_is_the_weighted_sum_and_zero_when_all_is_right() -> None:
    labels = torch.zeros(1, 20, 32, dtype=torch.uint8)
    labels[:, 5:, 10:] = 1
    pixels, visible = torch.tensor([[[12.3, 7.7]]]), torch.tensor([[True]])
    heatmaps = gaussian(pixels[0, 0], (20, 32), 1.5).clamp_min(1e-12).log().float()[None, None]
    right = Prediction(one_hot(labels.long(), 2) * 40, heatmaps, torch.tensor([[-30.0]]))
    perfect = MultiTaskLoss(sigma_px=1.5)(right, labels, pixels, visible)
    assert_close(perfect["loss"], torch.tensor(0.0), atol=1e-4, rtol=0)
    torch.manual_seed(3)
    wrong = Prediction(*(torch.randn_like(part) for part in right))
    parts = MultiTaskLoss(sigma_px=1.5, landmark_weight=0.25)(wrong, labels, pixels, visible)
    assert_close(parts["loss"], parts["segmentation"] + 0.25 * parts["landmarks"])
    logits = wrong.segmentation
    assert_close(parts["segmentation"], dice_loss(logits.softmax(1), labels) + F.cross_entropy(logits, labels.long()))
