"""Flips and moves carry labels and landmarks along; the same generator gives the same bits."""

import torch
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.volume import HIP_LANDMARKS
from training.augmentation import (
    AugmentationSettings,
    compose,
    flip_sides,
    inside,
    make_batch,
    move,
    random_affine,
)

SETTINGS = AugmentationSettings()


def blobs(landmarks: Tensor, size: int, sigma: float = 2.0) -> Tensor:
    """Images (B, size, size) with a Gaussian at the first landmark."""
    axis = torch.arange(size).float()
    column, row = landmarks[:, 0, :1, None], landmarks[:, 0, 1:, None]
    return torch.exp(-((axis - column) ** 2 + (axis[:, None] - row) ** 2) / (2 * sigma**2))


def centroid(images: Tensor) -> Tensor:
    axis = torch.arange(images.shape[-1]).float()
    total = images.sum((1, 2))
    return torch.stack([(images.sum(1) * axis).sum(1), (images.sum(2) * axis).sum(1)], -1) / total[:, None]


def test_a_flip_exchanges_sides() -> None:
    landmarks = torch.rand(1, 14, 2) * 192
    labels = torch.zeros(1, 96, 96, dtype=torch.uint8)
    labels[0, 0, :7] = torch.arange(7)
    images = torch.rand(1, 192, 192)
    flipped, flipped_labels, flipped_landmarks = flip_sides(images, labels, landmarks)
    assert flipped[0, 5, 0] == images[0, 5, 191]
    assert flipped_labels[0, 0, -7:].tolist() == [5, 6, 4, 3, 1, 2, 0]
    left, right = HIP_LANDMARKS.index("GSN-l"), HIP_LANDMARKS.index("GSN-r")
    assert_close(flipped_landmarks[0, left, 0], 191 - landmarks[0, right, 0])
    assert_close(flipped_landmarks[0, left, 1], landmarks[0, right, 1])
    back = flip_sides(flipped, flipped_labels, flipped_landmarks)
    assert_close(back[0], images)
    assert back[1].equal(labels)
    assert_close(back[2], landmarks, atol=1e-4, rtol=0)


def test_a_move_takes_image_labels_and_landmarks_along() -> None:
    generator = torch.Generator().manual_seed(2)
    landmarks = 60 + 72 * torch.rand((6, 14, 2), generator=generator)
    images = blobs(landmarks, 192)
    half = (landmarks - 0.5) / 2
    labels = (blobs(half, 96, 7.0) > 0.3).to(torch.uint8) * 4
    affine = random_affine(6, 192, SETTINGS, generator)
    moved, moved_labels, moved_landmarks = move(images, labels, landmarks, affine)
    assert_close(centroid(moved), moved_landmarks[:, 0], atol=0.05, rtol=0)
    shift = centroid((moved_labels == 4).float()) - (moved_landmarks[:, 0] - 0.5) / 2
    assert shift.abs().max() < 0.5  # labels are taken from the nearest pixel
    assert shift.mean(0).abs().max() < 0.15
    assert (moved_landmarks - landmarks).norm(dim=-1).max() > 5


def test_layers_add_up() -> None:
    plain = AugmentationSettings(tissue=(0.5, 0.5), bone=(2.0, 2.0), bone_spread=0.0, unevenness=0.0, gas=0.0)
    bones = torch.zeros(1, 6, 8, 8)
    bones[0, 2] = 0.25
    bones[0, 5] = 0.5
    image = compose(torch.full((1, 4, 4), 3.0), bones, plain, torch.Generator())
    assert_close(image, torch.full((1, 8, 8), 0.5 * 3 + 2 * 0.75))


def test_the_border_of_an_image() -> None:
    points = torch.tensor([[-0.4, 0], [-0.6, 0], [191.4, 191.4], [0, 191.6]])
    assert inside(points, (192, 192)).tolist() == [True, False, True, False]


def test_batches_are_reproducible_normalised_and_consistent() -> None:
    generator = torch.Generator().manual_seed(4)
    tissue = torch.full((4, 96, 96), 4.0)
    bones = torch.rand((4, 6, 192, 192), generator=generator)
    labels = torch.randint(0, 7, (4, 96, 96), generator=generator).to(torch.uint8)
    landmarks = torch.rand((4, 14, 2), generator=generator) * 230 - 20
    first, second = (
        make_batch(tissue, bones, labels, landmarks, SETTINGS, torch.Generator().manual_seed(5)) for _ in range(2)
    )
    for a, b in zip(first, second, strict=True):
        assert a.equal(b)
    assert_close(first.images.mean((1, 2, 3)), torch.zeros(4), atol=1e-4, rtol=0)
    assert_close(first.images.std((1, 2, 3)), torch.ones(4), atol=1e-3, rtol=0)
    assert torch.isfinite(first.images).all()
    assert inside(first.landmarks, (96, 96))[first.visible].all()
