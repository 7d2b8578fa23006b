"""The detector: from energy that falls on it, in units of the open beam, to raw 16-bit counts.

A flat panel, or an image intensifier, which spreads and loses light besides.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.geometry import Camera

_FULL_SCALE = 65535
_PATTERN_SEED = 20_200_101  # of the gain pattern: every image of a detector shows the same one
_BLUR_ENDS = 4.0  # standard deviations from the middle of a blur to its end


def record_quanta(energy: Tensor, photons: float, blur_sigma_px: float, generator: torch.Generator) -> Tensor:
    """Photons (H, W) that are recorded where `photons` would fall on a pixel of the open beam.

    Quanta are Poisson and are spread by the scintillator, so their noise is correlated.
    """
    quanta = torch.poisson((energy * photons).to(torch.float32), generator=generator)
    return blur(quanta, blur_sigma_px)


def veiling_glare(light: Tensor, camera: Camera, share: float, width_mm: float) -> Tensor:
    """Light (H, W) of an image intensifier, a share of which is spread widely over its output.

    The spread is share · exp(−r / width) / (2π · width · r), with a long tail (Seibert, Nalcioglu, Roeck, Med Phys 11
    (1984) 172, and 12 (1985) 281); its transform is share / √(1 + (2π · width · frequency)²). It keeps all light but
    what is spread past the edges of the detector, beyond which nothing is lit.
    """
    coarse = max(1, round(width_mm / camera.pixel_mm[0] / 8))  # the tail is smooth: 8 samples to its width
    small = F.avg_pool2d(light[None, None], coarse, ceil_mode=True)[0, 0]
    size = [2 * n for n in small.shape]  # so that nothing comes back around the other side
    rows, columns = (torch.fft.fftfreq(n, spacing * coarse) for n, spacing in zip(size, camera.pixel_mm, strict=True))
    columns = columns[: size[1] // 2 + 1].abs()
    transfer = 1 / (1 + (2 * math.pi * width_mm) ** 2 * (rows[:, None] ** 2 + columns**2)).sqrt()
    spread = torch.fft.irfft2(torch.fft.rfft2(small, s=size) * transfer, s=size)[: small.shape[0], : small.shape[1]]
    padded = [n * coarse for n in small.shape]
    wide = F.interpolate(spread[None, None], size=padded, mode="bilinear", align_corners=False)[0, 0]
    return (1 - share) * light + share * wide[: light.shape[0], : light.shape[1]]


def vignetting(camera: Camera, loss: float) -> Tensor:
    """Share (H, W) of the light that optics pass on: all in the middle, less by `loss` at the middle of the edges.

    It falls with the square of the distance, which are the first terms of the cos⁴ law (Bushberg et al., The Essential
    Physics of Medical Imaging, 3rd ed. 2012, chapter 9: vignetting).
    """
    distance = camera.pixel_positions(torch.float32)[..., :2].norm(dim=-1)
    return (1 - loss * (distance / (camera.shape[1] * camera.pixel_mm[1] / 2)) ** 2).clamp_min(0)


def digitise(signal: Tensor, counts_per_photon: float) -> Tensor:
    """Raw counts (H, W) uint16 of photons (H, W); what is beyond the range saturates."""
    return (signal * counts_per_photon).round_().clamp_(0, _FULL_SCALE).to(torch.uint16)


def blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur (H, W) that keeps the mean of the image (mirrored border)."""
    if sigma_px == 0:
        return image.clone()
    half = int(_BLUR_ENDS * sigma_px + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma_px) ** 2)
    kernel /= kernel.sum()
    return torch.from_numpy(cv2.sepFilter2D(image.numpy(), cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT))


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
