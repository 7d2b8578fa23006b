"""Training images out of stored layers: appearance and geometry are drawn anew for every image.

All functions work on batches and take the torch generator they draw from. The physics is coarse, made for variety:
Beer-Lambert attenuation, scatter as a blurred share of the primary beam, noise of the variance of Poisson's, detector
blur and saturation.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from kornia.filters import gaussian_blur2d
from kornia.geometry.transform import warp_affine
from torch import Generator, Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import normalise
from femoreg_torch.settings import check_rising, check_within
from training.implants import add_implants

_COARSE_KNOTS, _FINE_KNOTS = 4, 14  # along each axis of the image, of the fields `unevenness` and `gas`


@dataclass(frozen=True)
class AugmentationSettings:
    """Ranges of the uniform draws, and shares of the images that something happens to."""

    tissue: tuple[float, float] = (0.4, 0.9)  # factor of soft tissue's attenuation
    bone: tuple[float, float] = (0.6, 1.6)  # factor of bone's attenuation above soft tissue: density
    bone_spread: float = 0.2  # and of each bone by itself
    unevenness: float = 0.4  # scale of a smooth random field added to the attenuation
    gas: float = 0.15  # and of a finer one, as of gas and folds of soft tissue
    edge_share: float = 0.15  # table edges and covers: a straight step of attenuation
    instrument_share: float = 0.35
    implant_share: float = 0.0  # of the femora in view: nails, plates, artificial hips
    device_share: float = 0.25  # images with a drilling device, where the cohort has any
    device: tuple[float, float] = (0.15, 1.2)  # factor of its attenuation; log-uniform
    vignetting: float = 0.4  # greatest loss of signal in the corners
    scatter: tuple[float, float] = (0.0, 0.6)  # relative to the mean of the primary beam
    photons: tuple[float, float] = (200.0, 20000.0)  # per pixel of the network's grid at the mean; log-uniform
    blur_px: tuple[float, float] = (0.01, 1.2)
    saturation_share: float = 0.3
    gamma: tuple[float, float] = (0.6, 1.7)
    inverted_share: float = 0.05
    collimated_share: float = 0.25
    collimated_middle: tuple[float, float] = (0.42, 0.58)  # of the field's middle, as shares of the image's width
    collimated_half: tuple[float, float] = (0.32, 0.5)  # and of its half width and half height
    erased_share: float = 0.2
    rotation_deg: float = 12.0
    scale: tuple[float, float] = (0.85, 1.15)
    shift_px: float = 20.0
    flipped_share: float = 0.5

    def __post_init__(self) -> None:
        shares = [name for name in self.__dataclass_fields__ if name.endswith("_share")]
        check_within(
            self,
            **dict.fromkeys(shares, (0.0, 1.0)),
            tissue=(0, 10),
            bone=(0, 10),
            bone_spread=(0, 1),
            unevenness=(0, 10),
            gas=(0, 10),
            device=(1e-3, 100),
            vignetting=(0, 1),
            scatter=(0, 100),
            photons=(1, 1e15),
            blur_px=(1e-3, 20),
            gamma=(0.01, 10),
            collimated_middle=(0, 1),
            collimated_half=(0.01, 1),
            rotation_deg=(0, 180),
            scale=(0.1, 10),
            shift_px=(0, 192),
        )
        pairs = ("tissue", "bone", "device", "scatter", "photons", "blur_px", "gamma", "scale")
        check_rising(self, *pairs, "collimated_middle", "collimated_half")


class Batch(NamedTuple):
    """What a network is trained on: images on its grid, truth on the grid of its output (half as fine)."""

    images: Tensor  # (B, 1, 192, 192), normalised
    labels: Tensor  # (B, 96, 96) uint8
    landmarks: Tensor  # (B, L, 2) column, row
    visible: Tensor  # (B, L) bool


def _uniform(low: float, high: float, shape: tuple[int, ...], generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


def _log_uniform(low: float, high: float, shape: tuple[int, ...], generator: Generator) -> Tensor:
    return torch.exp(_uniform(math.log(low), math.log(high), shape, generator))


def _chosen(share: float, count: int, generator: Generator) -> Tensor:
    return torch.rand((count, 1, 1), generator=generator) < share


def compose(tissue: Tensor, bones: Tensor, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """Attenuation (B, H, W) of weighted layers: `tissue` (B, H / 2, W / 2), `bones` (B, bones, H, W)."""
    count, number = bones.shape[:2]
    soft = F.interpolate(tissue.float()[:, None], scale_factor=2, mode="bilinear")[:, 0]
    spread = _uniform(1 - settings.bone_spread, 1 + settings.bone_spread, (count, number, 1, 1), generator)
    weights = (_uniform(*settings.bone, (count, 1, 1, 1), generator) * spread).view(count, 1, number)
    bone = (weights @ bones.float().flatten(2)).view(soft.shape)
    unevenness = _smooth_field(count, _COARSE_KNOTS, soft.shape[1:], generator) * settings.unevenness
    unevenness += _smooth_field(count, _FINE_KNOTS, soft.shape[1:], generator) * settings.gas
    return soft * _uniform(*settings.tissue, (count, 1, 1), generator) + bone + unevenness


def _smooth_field(count: int, knots: int, shape: torch.Size, generator: Generator) -> Tensor:
    """Fields (B, H, W) through normal deviates at `knots` × `knots` places, each image's scaled by its own 0 … 1."""
    values = torch.randn((count, knots, knots), generator=generator) * torch.rand((count, 1, 1), generator=generator)
    # The interpolation is separable, and this small: two products with its matrix beat an image operation by far.
    rows, columns = (_interpolation(knots, size) for size in shape)
    return rows @ values @ columns.mT


@cache
def _interpolation(knots: int, size: int) -> Tensor:
    """Matrix (size, knots) of the bicubic interpolation from knots to pixels."""
    return F.interpolate(torch.eye(knots)[None, None], (size, knots), mode="bicubic", align_corners=True)[0, 0]


def flip_sides(images: Tensor, labels: Tensor, landmarks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mirrored patient: images (..., W), labels and (column, row) landmarks, with left and right exchanged.

    `landmarks` are in pixels of the images.
    """
    swapped = landmarks[..., list(HIP.mirrored_landmarks), :].clone()
    swapped[..., 0] = images.shape[-1] - 1 - swapped[..., 0]
    mirrored_class = torch.tensor(HIP.mirrored_classes, dtype=torch.uint8)
    return images.flip(-1), mirrored_class[labels.flip(-1).long()], swapped


def inside(landmarks: Tensor, shape: tuple[int, int]) -> Tensor:
    """Which (column, row) positions (..., 2) lie on an image of `shape` (rows, columns)."""
    column, row = landmarks.unbind(-1)
    return (column >= -0.5) & (column <= shape[1] - 0.5) & (row >= -0.5) & (row <= shape[0] - 0.5)


def random_affine(count: int, size: int, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """`new_from_old` (B, 3, 3) in pixels of a square image: turn and scale about its middle, then shift."""
    angle = _uniform(-1, 1, (count,), generator) * math.radians(settings.rotation_deg)
    scale = _uniform(*settings.scale, (count,), generator)
    c, s = scale * angle.cos(), scale * angle.sin()
    linear = torch.stack([c, -s, s, c], -1).view(count, 2, 2)
    middle = (size - 1) / 2
    shift = _uniform(-settings.shift_px, settings.shift_px, (count, 2), generator)
    affine = torch.eye(3).repeat(count, 1, 1)
    affine[:, :2, :2] = linear
    affine[:, :2, 2] = middle + shift - linear.sum(-1) * middle
    return affine


def move(images: Tensor, labels: Tensor, landmarks: Tensor, affine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Images (B, H, W), labels on every second pixel and landmarks (B, L, 2), all moved by `affine` in image pixels."""
    shape = (images.shape[1], images.shape[2])
    moved = warp_affine(images[:, None], affine[:, :2], shape, padding_mode="border", align_corners=True)[:, 0]
    fine_from_coarse = torch.tensor([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]])
    coarse = torch.linalg.inv(fine_from_coarse) @ affine @ fine_from_coarse
    half = (labels.shape[1], labels.shape[2])
    moved_labels = warp_affine(labels[:, None].float(), coarse[:, :2], half, mode="nearest", align_corners=True)
    points = landmarks @ affine[:, :2, :2].mT + affine[:, None, :2, 2]
    return moved, moved_labels[:, 0].round().to(torch.uint8), points


def add_instruments(attenuation: Tensor, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """Up to two straight metal rods and a plate in some of the images (B, H, W), and the edge of a table in others."""
    count, height, width = attenuation.shape
    row, column = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    chosen = _chosen(settings.instrument_share, count, generator)
    for number in range(3):
        there = chosen & _chosen(0.6, count, generator)
        middle = _uniform(-0.1 * width, 1.1 * width, (count, 2, 1, 1), generator)
        angle = _uniform(0, math.pi, (count, 1, 1), generator)
        x, y = column - middle[:, 0], row - middle[:, 1]
        along, across = (x * angle.cos() + y * angle.sin()).abs(), (y * angle.cos() - x * angle.sin()).abs()
        half_length = _log_uniform(20, 0.8 * width, (count, 1, 1), generator)
        depth = _log_uniform(0.2, 4.0, (count, 1, 1), generator) * there
        ends = (half_length + 0.5 - along).clamp(0, 1)
        if number < 2:
            radius = _log_uniform(0.8, 12.0, (count, 1, 1), generator)
            # chord of a round rod, with half a pixel of blur at its rim
            profile = ((radius + 0.5 - across).clamp_min(0) / (radius + 0.5)).sqrt()
        else:
            profile = (_log_uniform(3, 40, (count, 1, 1), generator) + 0.5 - across).clamp(0, 1)
        attenuation = attenuation + depth * ends * profile
    angle = _uniform(0, 2 * math.pi, (count, 1, 1), generator)
    distance = (column - width / 2) * angle.cos() + (row - height / 2) * angle.sin()
    step = _chosen(settings.edge_share, count, generator) * _uniform(0.05, 0.5, (count, 1, 1), generator)
    return attenuation + step * (distance - _uniform(-0.4, 0.4, (count, 1, 1), generator) * width).clamp(0, 1)


def add_devices(attenuation: Tensor, devices: Tensor, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """One of `devices` (N, H, H), turned by quarters and mirrored, laid over some of the images (B, H, H)."""
    count = len(attenuation)
    shadows = devices[torch.randint(len(devices), (count,), generator=generator)].float()
    for change in (lambda image: image.mT, lambda image: image.flip(-1), lambda image: image.flip(-2)):
        shadows = torch.where(_chosen(0.5, count, generator), change(shadows), shadows)
    there = _chosen(settings.device_share, count, generator)
    return attenuation + there * _log_uniform(*settings.device, (count, 1, 1), generator) * shadows


def expose(attenuation: Tensor, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """Attenuation (B, H, W) as a detector would show it: scatter, vignetting, noise, blur, saturation.

    The number of photons is drawn from the normal distribution of the same mean and variance as Poisson's.
    """
    count = len(attenuation)
    primary = torch.exp(-attenuation.clamp_min(0))
    primary = primary / primary.mean((1, 2), keepdim=True)
    coarse = F.avg_pool2d(primary[:, None], 8)
    spread = F.interpolate(gaussian_blur2d(coarse, (7, 7), (3.0, 3.0)), primary.shape[1:], mode="bilinear")[:, 0]
    beam = primary + _uniform(*settings.scatter, (count, 1, 1), generator) * spread
    beam = beam * (1 - _uniform(0, settings.vignetting, (count, 1, 1), generator) * _corners(beam.shape[1:]))
    photons = _log_uniform(*settings.photons, (count, 1, 1), generator)
    noise = torch.randn(beam.shape, generator=generator) * (beam / photons).sqrt()
    sigma = _uniform(*settings.blur_px, (count, 1), generator).expand(count, 2)
    signal = gaussian_blur2d((beam + noise).clamp_min(0)[:, None], (7, 7), sigma)[:, 0]
    middling = signal[:, ::4, ::4].flatten(1).median(1).values[:, None, None]
    ceiling = middling * _uniform(1.5, 6, (count, 1, 1), generator)
    signal = torch.where(_chosen(settings.saturation_share, count, generator), signal.minimum(ceiling), signal)
    return -torch.log(torch.maximum(signal, 0.3 / photons))


@cache
def _corners(shape: torch.Size) -> Tensor:
    """Squared distance (H, W) from the middle, 1 in the corners."""
    rows, columns = (torch.linspace(-1, 1, size) ** 2 for size in shape)
    return (rows[:, None] + columns) / 2


def alter_contrast(images: Tensor, settings: AugmentationSettings, generator: Generator) -> Tensor:
    """Gamma of the grey values between the extremes of each image (B, H, W), and rarely an inversion; 0 to 1."""
    count = len(images)
    low, high = images.amin((1, 2), keepdim=True), images.amax((1, 2), keepdim=True)
    gamma = _log_uniform(*settings.gamma, (count, 1, 1), generator)
    grey = ((images - low) / (high - low).clamp_min(1e-6)) ** gamma
    return torch.where(_chosen(settings.inverted_share, count, generator), 1 - grey, grey)


def collimate(
    images: Tensor,
    labels: Tensor,
    landmarks: Tensor,
    visible: Tensor,
    settings: AugmentationSettings,
    generator: Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Some images (B, H, W) cut down to a rectangle or a disc; what lies outside is neither labelled nor visible."""
    count, height, width = images.shape
    chosen = _chosen(settings.collimated_share, count, generator)
    middle = _uniform(*settings.collimated_middle, (count, 2, 1, 1), generator) * width
    half = _uniform(*settings.collimated_half, (count, 2, 1, 1), generator) * width
    round_field = _chosen(0.5, count, generator)

    def covered(column: Tensor, row: Tensor) -> Tensor:
        x, y = ((v - middle[:, n]) / half[:, n] for n, v in enumerate((column, row)))
        return chosen & torch.where(round_field, x**2 + y**2 > 1, torch.maximum(x.abs(), y.abs()) > 1)

    row, column = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    shadow = covered(column[None], row[None])
    level = torch.where(_chosen(0.5, count, generator), images.amax((1, 2), True), images.amin((1, 2), True))
    hidden = covered(landmarks[:, :, 0][:, None], landmarks[:, :, 1][:, None])[:, 0]
    return (
        torch.where(shadow, level, images),
        labels.masked_fill(shadow[:, ::2, ::2], 0),
        visible & ~hidden,
    )


def erase_boxes(images: Tensor, share: float, generator: Generator) -> Tensor:
    """Two boxes of constant grey in some of the images (B, H, W)."""
    count, height, width = images.shape
    row, column = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    chosen = _chosen(share, count, generator)
    for _ in range(2):
        middle = _uniform(0, width, (count, 2, 1, 1), generator)
        half = _uniform(4, 20, (count, 2, 1, 1), generator)
        box = ((column - middle[:, 0]).abs() < half[:, 0]) & ((row - middle[:, 1]).abs() < half[:, 1])
        grey = _uniform(0, 1, (count, 1, 1), generator)
        images = torch.where(chosen & box, grey, images)
    return images


def make_batch(
    tissue: Tensor,
    bones: Tensor,
    labels: Tensor,
    landmarks: Tensor,
    settings: AugmentationSettings,
    generator: Generator,
    devices: Tensor | None = None,
) -> Batch:
    """Training images from stored layers and shadows of `devices`.

    Shapes of the layers are those of `sim.labelled.training_views`, with N = B views.
    """
    images = compose(tissue, bones, settings, generator)
    count, shape = len(images), (images.shape[1], images.shape[2])
    flipped = flip_sides(images, labels, landmarks)
    mirror = _chosen(settings.flipped_share, count, generator)
    images = torch.where(mirror, flipped[0], images)
    labels = torch.where(mirror, flipped[1], labels)
    landmarks = torch.where(mirror, flipped[2], landmarks)
    visible = inside(landmarks, shape)
    images, labels, landmarks = move(images, labels, landmarks, random_affine(count, shape[0], settings, generator))
    visible &= inside(landmarks, shape)
    if settings.implant_share:
        images = add_implants(images, labels, landmarks, settings.implant_share, generator)
    images = add_instruments(images, settings, generator)
    if devices is not None:
        images = add_devices(images, devices, settings, generator)
    images = expose(images, settings, generator)
    images = alter_contrast(images, settings, generator)
    images, labels, visible = collimate(images, labels, landmarks, visible, settings, generator)
    images = erase_boxes(images, settings.erased_share, generator)
    return Batch(normalise(images)[:, None], labels, (landmarks - 0.5) / 2, visible)
