"""Every augmentation by itself, against what it should do to a picture whose truth is known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from training.augmentation import (
    AugmentationSettings,
    add_instruments,
    alter_contrast,
    collimate,
    compose,
    erase_boxes,
    expose,
    flip_sides,
    inside,
    make_batch,
    move,
    random_affine,
)

SETTINGS = AugmentationSettings()
LANDMARKS, BONES = len(HIP.landmarks), len(HIP.bones)
(SACRUM,) = HIP.classes(["sacrum"])


def drawing(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def blobs(landmarks: Tensor, size: int, sigma: float = 2.0) -> Tensor:
    """Images (B, size, size) with a Gaussian at the first landmark."""
    axis = torch.arange(size).float()
    column, row = landmarks[:, 0, :1, None], landmarks[:, 0, 1:, None]
    return torch.exp(-((axis - column) ** 2 + (axis[:, None] - row) ** 2) / (2 * sigma**2))


def centroid(images: Tensor) -> Tensor:
    axis = torch.arange(images.shape[-1]).float()
    total = images.sum((1, 2))
    return torch.stack([(images.sum(1) * axis).sum(1), (images.sum(2) * axis).sum(1)], -1) / total[:, None]


# Layers


PLAIN_LAYERS = replace(SETTINGS, tissue=(0.5, 0.5), bone=(2.0, 2.0), bone_spread=0.0, unevenness=0.0, gas=0.0)


def test_layers_add_up() -> None:
    bones = torch.zeros(1, BONES, 8, 8)
    bones[0, 2] = 0.25
    bones[0, 5] = 0.5
    image = compose(torch.full((1, 4, 4), 3.0), bones, PLAIN_LAYERS, drawing(0))
    assert_close(image, torch.full((1, 8, 8), 0.5 * 3 + 2 * 0.75))


def test_each_bone_has_a_density_of_its_own() -> None:
    """The bones lie side by side in one column each, so that the picture shows their factors."""
    bones = torch.eye(BONES)[:, None].expand(BONES, BONES, BONES)[None].repeat(200, 1, 1, 1)
    settings = replace(PLAIN_LAYERS, bone=(1.0, 2.0), bone_spread=0.1)
    factors = compose(torch.zeros(200, BONES // 2, BONES // 2), bones, settings, drawing(1))[:, 0]
    assert factors.min() >= 0.9
    assert factors.max() <= 2.2
    spread = factors.amax(1) / factors.amin(1)
    assert (spread > 1).all()
    assert spread.max() <= 1.1 / 0.9 + 1e-5
    assert factors.mean(1).min() < 1.2
    assert factors.mean(1).max() > 1.8


@pytest.mark.parametrize(("name", "knots"), [("unevenness", 4), ("gas", 14)])
def test_unevenness_is_smooth_and_has_no_sign(name: str, knots: int) -> None:
    settings = replace(PLAIN_LAYERS, **{name: 1.0})
    field = compose(torch.zeros(400, 48, 48), torch.zeros(400, BONES, 96, 96), settings, drawing(2))
    # the product of a normal deviate and a uniform one in 0 … 1 has mean 0 and a mean square of 1 / 3
    assert abs(field.mean().item()) < 0.03
    at_knot = field[:, 0, 0]  # the corner is a knot
    assert at_knot.square().mean().item() == pytest.approx(1 / 3, abs=0.08)
    between_pixels = (field[:, :, 1:] - field[:, :, :-1]).square().mean().sqrt()
    between_knots = at_knot.square().mean().sqrt() * math.sqrt(2)
    assert between_pixels < 2 * between_knots * (knots - 1) / 95


# Geometry


def test_a_flip_exchanges_sides() -> None:
    landmarks = torch.rand((1, LANDMARKS, 2), generator=drawing(3)) * 192
    labels = torch.zeros(1, 96, 96, dtype=torch.uint8)
    bones = ("hip_left", "hip_right", "vertebrae", "sacrum", "femur_left", "femur_right")
    mirrored = ("hip_right", "hip_left", "vertebrae", "sacrum", "femur_right", "femur_left")
    labels[0, 0, : len(bones)] = torch.tensor(HIP.classes(bones))
    images = torch.rand((1, 192, 192), generator=drawing(4))
    flipped, flipped_labels, flipped_landmarks = flip_sides(images, labels, landmarks)
    assert flipped[0, 5, 0] == images[0, 5, 191]
    assert flipped_labels[0, 0, -len(bones) :].tolist() == list(reversed(HIP.classes(mirrored)))
    left, right = HIP.landmark_names.index("GSN-l"), HIP.landmark_names.index("GSN-r")
    assert_close(flipped_landmarks[0, left, 0], 191 - landmarks[0, right, 0])
    assert_close(flipped_landmarks[0, left, 1], landmarks[0, right, 1])
    back = flip_sides(flipped, flipped_labels, flipped_landmarks)
    assert_close(back[0], images)
    assert back[1].equal(labels)
    assert_close(back[2], landmarks, atol=1e-4, rtol=0)


def test_affine_maps_turn_and_scale_about_the_middle_within_their_ranges() -> None:
    affine = random_affine(500, 192, SETTINGS, drawing(5))
    scale = torch.linalg.det(affine[:, :2, :2]).sqrt()
    angle = torch.rad2deg(torch.atan2(affine[:, 1, 0], affine[:, 0, 0]))
    middle = torch.tensor([95.5, 95.5, 1.0])
    shift = (affine @ middle - middle)[:, :2]
    for drawn, low, high in ((scale, 0.85, 1.15), (angle, -12.0, 12.0), (shift, -20.0, 20.0)):
        width = high - low
        assert low - 1e-3 <= drawn.min() <= low + 0.05 * width
        assert high - 0.05 * width <= drawn.max() <= high + 1e-3
    rotation = affine[:, :2, :2] / scale[:, None, None]
    assert_close(rotation @ rotation.mT, torch.eye(2).expand(500, 2, 2), atol=1e-5, rtol=0)


def test_a_shift_by_whole_pixels_copies_pixels() -> None:
    """+6 columns and −4 rows: image pixels, every second of which has a label, and landmarks."""
    affine = torch.eye(3)[None].clone()
    affine[0, :2, 2] = torch.tensor([6.0, -4.0])
    images = torch.rand((1, 32, 32), generator=drawing(6))
    labels = torch.randint(0, 1 + BONES, (1, 16, 16), generator=drawing(7)).to(torch.uint8)
    moved, moved_labels, points = move(images, labels, torch.tensor([[[10.0, 12.0]]]), affine)
    assert_close(moved[:, :28, 6:], images[:, 4:, :26], atol=1e-5, rtol=0)
    assert_close(moved[:, :28, :6], images[:, 4:, :1].expand(1, 28, 6), atol=1e-5, rtol=0)  # the border goes on
    assert moved_labels[:, :14, 3:].equal(labels[:, 2:, :13])
    assert not moved_labels[:, :, :3].any()  # but no bone is known there
    assert points.tolist() == [[[16.0, 8.0]]]


def test_a_move_takes_image_labels_and_landmarks_along() -> None:
    generator = drawing(2)
    landmarks = 60 + 72 * torch.rand((6, LANDMARKS, 2), generator=generator)
    images = blobs(landmarks, 192)
    half = (landmarks - 0.5) / 2
    labels = (blobs(half, 96, 7.0) > 0.3).to(torch.uint8) * SACRUM
    affine = random_affine(6, 192, SETTINGS, generator)
    moved, moved_labels, moved_landmarks = move(images, labels, landmarks, affine)
    assert_close(centroid(moved), moved_landmarks[:, 0], atol=0.05, rtol=0)
    assert set(moved_labels.unique().tolist()) == {0, SACRUM}
    shift = centroid((moved_labels == SACRUM).float()) - (moved_landmarks[:, 0] - 0.5) / 2
    assert shift.abs().max() < 0.5  # labels are taken from the nearest pixel
    assert shift.mean(0).abs().max() < 0.15
    assert (moved_landmarks - landmarks).norm(dim=-1).max() > 5


def test_the_border_of_an_image() -> None:
    points = torch.tensor([[-0.4, 0], [-0.6, 0], [191.4, 191.4], [0, 191.6]])
    assert inside(points, (192, 192)).tolist() == [True, False, True, False]


# What lies in the beam


def test_instruments_add_metal_to_the_chosen_share() -> None:
    settings = replace(SETTINGS, instrument_share=0.5, edge_share=0.0)
    added = add_instruments(torch.full((400, 96, 96), 2.0), settings, drawing(8)) - 2
    assert added.min() >= 0
    assert added.max() <= 3 * 4.0  # two rods and a plate
    # each of the three is there in 0.6 of the chosen images, 0.5 · (1 − 0.4³) = 0.47 in all; some lie beside the image
    assert 0.36 < (added.amax((1, 2)) > 0.1).float().mean() < 0.47 + 3 * 0.025
    without = add_instruments(torch.full((9, 96, 96), 2.0), replace(settings, instrument_share=0.0), drawing(8))
    assert without.eq(2).all()


def test_a_table_edge_is_one_straight_step() -> None:
    settings = replace(SETTINGS, instrument_share=0.0, edge_share=1.0)
    added = add_instruments(torch.zeros(200, 96, 96), settings, drawing(9))
    step = added.amax((1, 2), keepdim=True)
    assert step.min() >= 0.05
    assert step.max() <= 0.5
    covered = added > step / 2
    ramp = (added > 0) & (added < step)
    assert ramp.float().mean() < 0.03  # a line, a pixel or so wide
    # a half-plane: every row is covered from one border on, so that it changes at most once
    assert ((covered[:, :, 1:] != covered[:, :, :-1]).sum(2) <= 1).all()
    assert ((covered[:, 1:] != covered[:, :-1]).sum(1) <= 1).all()


# The detector


QUIET = replace(
    SETTINGS, vignetting=0.0, scatter=(0.0, 0.0), photons=(1e9, 1e9), blur_px=(0.01, 0.01), saturation_share=0.0
)


def test_a_perfect_detector_shows_the_attenuation() -> None:
    """Up to a constant: the primary beam is relative to its mean."""
    attenuation = 3 * torch.rand((2, 64, 64), generator=drawing(10))
    shown = expose(attenuation, QUIET, drawing(11))
    constant = torch.exp(-attenuation).mean((1, 2), keepdim=True).log()
    assert_close(shown, attenuation + constant, atol=2e-3, rtol=0)


def test_scatter_adds_its_share_to_a_uniform_beam() -> None:
    shown = expose(torch.full((3, 64, 64), 2.0), replace(QUIET, scatter=(0.5, 0.5)), drawing(12))
    assert_close(shown, torch.full_like(shown, -math.log(1.5)), atol=1e-3, rtol=0)


def test_scatter_flattens_contrast_and_stays_in_place() -> None:
    attenuation = 2 * blobs(torch.tensor([[[40.0, 24.0]]]), 64, 4.0)
    shown = expose(attenuation, replace(QUIET, scatter=(0.5, 0.5)), drawing(13))
    shadow = shown - shown.amin((1, 2), keepdim=True)
    assert 0.5 < shadow.max() < 1.6  # of 2
    assert (centroid((shadow > shadow.max() / 2).float()) - torch.tensor([[40.0, 24.0]])).norm() < 0.1


def test_vignetting_darkens_the_corners_most() -> None:
    shown = expose(torch.zeros(300, 65, 65), replace(QUIET, vignetting=0.4), drawing(14))
    signal = torch.exp(-shown)
    assert_close(signal[:, 32, 32], torch.ones(300), atol=1e-3, rtol=0)
    loss = 1 - signal[:, 0, 0]
    assert 0 <= loss.min() < 0.02
    assert 0.38 < loss.max() <= 0.4 + 1e-3
    # the square of the distance from the middle: at the middle of a side it is half that of the corner
    assert_close(1 - signal[:, 0, 32], loss / 2, atol=2e-3, rtol=0)


@pytest.mark.parametrize("photons", [400.0, 10000.0])
def test_noise_is_that_of_the_number_of_photons(photons: float) -> None:
    """A deviation of 1 / √N, relative to the signal; so much of −log of it, where N is large."""
    shown = expose(torch.zeros(4, 128, 128), replace(QUIET, photons=(photons, photons)), drawing(15))
    assert shown.std().item() == pytest.approx(photons**-0.5, rel=0.02)


def test_blur_widens_an_edge_without_moving_it() -> None:
    attenuation = torch.zeros(1, 64, 64)
    attenuation[:, :, 32:] = 1e-2  # small, so that −log is linear
    near = torch.arange(24, 40)
    for sigma, width in ((0.01, 0.0), (1.2, 1.2)):
        image = expose(attenuation, replace(QUIET, photons=(1e14, 1e14), blur_px=(sigma, sigma)), drawing(16))[0, 32]
        slope = (image[near] - image[near - 1]).double() / 1e-2
        place = near - 0.5 - 31.5
        assert slope.sum().item() == pytest.approx(1, abs=1e-3)
        assert (slope * place).sum().item() == pytest.approx(0, abs=0.01)
        # 7 pixels cut the tails of the widest Gaussian off
        assert (slope * place**2).sum().item() == pytest.approx(width**2, abs=0.1)


def test_saturation_limits_the_brightest_signal() -> None:
    attenuation = torch.full((200, 64, 64), 3.0)
    attenuation[:, :8, :8] = 0.0  # 20 times as bright as the rest
    shown = expose(attenuation, replace(QUIET, saturation_share=1.0), drawing(17))
    ratio = torch.exp(shown[:, 40, 40] - shown[:, 2, 2])
    assert ratio.min() > 1.45
    assert ratio.max() < 6.1
    assert shown[:, 32:, 32:].std((1, 2)).max() < 1e-3  # what is below the ceiling stays


# Contrast


def test_gamma_is_a_power_of_the_grey_values() -> None:
    images = torch.tensor([[[2.0, 3.0], [4.0, 6.0]]])
    changed = alter_contrast(images, replace(SETTINGS, gamma=(2.0, 2.0), inverted_share=0.0), drawing(18))
    assert_close(changed, torch.tensor([[[0.0, 1 / 16], [1 / 4, 1.0]]]))
    inverted = alter_contrast(images, replace(SETTINGS, gamma=(2.0, 2.0), inverted_share=1.0), drawing(18))
    assert_close(inverted, 1 - changed)


def test_contrast_keeps_the_order_of_the_grey_values() -> None:
    images = torch.rand((100, 6, 6), generator=drawing(19))
    changed = alter_contrast(images, replace(SETTINGS, inverted_share=0.0), drawing(20))
    assert changed.flatten(1).argsort(1).equal(images.flatten(1).argsort(1))


# What is not seen


def test_shutters_hide_image_labels_and_landmarks_alike() -> None:
    """About the middle, 48 of 192 pixels to each side: a square or a disc of this radius."""
    settings = replace(SETTINGS, collimated_share=1.0, collimated_middle=(0.5, 0.5), collimated_half=(0.25, 0.25))
    images = torch.rand((40, 192, 192), generator=drawing(21))
    labels = torch.full((40, 96, 96), SACRUM, dtype=torch.uint8)
    # in the middle; in a corner of the square but not in the disc; beyond both
    landmarks = torch.tensor([[96.0, 96.0], [134.0, 134.0], [150.0, 96.0]]).expand(40, 3, 2)
    visible = torch.ones(40, 3, dtype=torch.bool)
    changed, changed_labels, seen = collimate(images, labels, landmarks, visible, settings, drawing(22))
    open_field = (changed == images).sum((1, 2)).float()
    square = seen[:, 1]
    assert 8 <= square.sum() <= 32  # both forms occur
    assert_close(open_field[square], torch.full((int(square.sum()),), 97.0**2), rtol=0.01, atol=0)
    assert_close(open_field[~square], torch.full((int((~square).sum()),), math.pi * 48.0**2), rtol=0.01, atol=0)
    assert seen[:, 0].all()
    assert not seen[:, 2].any()
    assert set(changed_labels.unique().tolist()) == {0, SACRUM}
    assert_close((changed_labels > 0).sum((1, 2)) * 4.0, open_field, rtol=0.05, atol=0)
    covered = changed[:, 0, 0]
    extreme = (covered == images.amax((1, 2))) | (covered == images.amin((1, 2)))
    assert extreme.all()


def test_shutters_leave_the_other_images_alone() -> None:
    images = torch.rand((5, 32, 32), generator=drawing(23))
    labels = torch.full((5, 16, 16), SACRUM, dtype=torch.uint8)
    visible = torch.rand((5, 3), generator=drawing(24)) < 0.5
    settings = replace(SETTINGS, collimated_share=0.0)
    changed = collimate(images, labels, torch.zeros(5, 3, 2), visible, settings, drawing(25))
    for after, before in zip(changed, (images, labels, visible), strict=True):
        assert after.equal(before)


def test_erased_boxes_are_two_of_constant_grey() -> None:
    images = 2 + torch.rand((60, 128, 128), generator=drawing(26))  # no grey of a box, which is 0 … 1
    changed = erase_boxes(images, 1.0, drawing(27))
    for before, after in zip(images, changed, strict=True):
        erased = after != before
        greys = after[erased].unique()
        assert 1 <= len(greys) <= 2
        assert greys.max() <= 1
        rows, columns = ((after == greys[-1]).any(axis).sum() for axis in (1, 0))
        assert max(rows, columns) <= 40  # a half width of 20 pixels at most
    assert erase_boxes(images, 0.0, drawing(28)).equal(images)


# All together


def test_batches_are_reproducible_normalised_and_consistent() -> None:
    generator = drawing(4)
    tissue = torch.full((4, 96, 96), 4.0)
    bones = torch.rand((4, BONES, 192, 192), generator=generator)
    labels = torch.randint(0, 1 + BONES, (4, 96, 96), generator=generator).to(torch.uint8)
    landmarks = torch.rand((4, LANDMARKS, 2), generator=generator) * 230 - 20
    first, second = (make_batch(tissue, bones, labels, landmarks, SETTINGS, drawing(5)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.equal(b)
    assert_close(first.images.mean((1, 2, 3)), torch.zeros(4), atol=1e-4, rtol=0)
    assert_close(first.images.std((1, 2, 3)), torch.ones(4), atol=1e-3, rtol=0)
    assert torch.isfinite(first.images).all()
    assert inside(first.landmarks, (96, 96))[first.visible].all()
    assert first.labels.max() <= BONES
