"""The flat panel: from energy that falls on it, in units of the open beam, to raw 16-bit counts."""

import math

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

_FULL_SCALE = 65535
_PATTERN_SEED = 20_200_101  # of the gain pattern: every image of a detector shows the same one


def record_quanta(
    energy: Tensor, photons: float, blur_sigma_px: float, electronic_noise: float, generator: torch.Generator
) -> Tensor:
    """Photons (H, W) that are read out where `photons` would fall on a pixel of the open beam.

    Quanta are Poisson, are spread by the scintillator (so their noise is correlated), then electronic noise of this
    standard deviation, in photons, is added.
    """
    quanta = torch.poisson((energy * photons).to(torch.float32), generator=generator)
    signal = blur(quanta, blur_sigma_px)
    signal += electronic_noise * torch.randn(signal.shape, generator=generator)
    return signal


def digitise(signal: Tensor, counts_per_photon: float) -> Tensor:
    """Raw counts (H, W) uint16 of photons (H, W); what is beyond the range saturates."""
    return (signal * counts_per_photon).round_().clamp_(0, _FULL_SCALE).to(torch.uint16)


def blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur (H, W) that keeps the mean of the image (mirrored border)."""
    if sigma_px == 0:
        return image.clone()
    return torch.from_numpy(ndimage.gaussian_filter(image.numpy(), sigma_px, mode="reflect"))


def gain_pattern(shape: tuple[int, int], spread: float) -> Tensor:
    """Gain (H, W) of each pixel after flat-field correction: mean 1, and `spread` as standard deviation.

    Half of the variance, a share chosen here, is that of single pixels, half that of columns, which share an amplifier
    (on flat-field correction: Seibert et al., Proc SPIE 3336 (1998) 348).
    """
    generator = torch.Generator().manual_seed(_PATTERN_SEED)
    pixels, columns = torch.randn(shape, generator=generator), torch.randn(shape[1], generator=generator)
    return 1 + spread * math.sqrt(0.5) * (pixels + columns)


def motion_blur(image: Tensor, length_px: float, angle_rad: float) -> Tensor:
    """The image (H, W) smeared along a straight line of this length whose middle stays where it was."""
    half = math.ceil(length_px / 2) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for along in np.linspace(-length_px / 2, length_px / 2, 8 * half + 1):
        column, row = half + along * math.cos(angle_rad), half + along * math.sin(angle_rad)
        left, top = int(column), int(row)
        u, v = column - left, row - top
        kernel[top, left] += (1 - u) * (1 - v)
        kernel[top, left + 1] += u * (1 - v)
        kernel[top + 1, left] += (1 - u) * v
        kernel[top + 1, left + 1] += u * v
    return torch.from_numpy(cv2.filter2D(image.numpy(), -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT))
