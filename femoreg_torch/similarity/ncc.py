"""Normalised cross-correlation of grey values, over the whole image or over patches."""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.similarity.kernels import patch_sums, patch_weights

_FLAT = 1e-10


@dataclass(frozen=True, eq=False)
class Ncc:
    """NCC against one fixed image; made by `ncc`."""

    fixed: Tensor  # (H, W) float64
    weights: Tensor  # of the patches, summing to one
    radius: int | None  # None: the whole image is one patch

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 2], float64, of images (B, H, W): weighted mean of 1 − NCC; a flat patch has NCC 0."""
        if images.shape[1:] != self.fixed.shape:
            raise InputError(
                f"similarity: images are {tuple(images.shape[1:])}, the fixed one {tuple(self.fixed.shape)}."
            )
        moving = images.to(torch.float64)
        count = float(self.fixed.numel() if self.radius is None else (2 * self.radius + 1) ** 2)
        sum_f, sum_m = self._sums(self.fixed), self._sums(moving)
        spread_f = self._sums(self.fixed**2) - sum_f**2 / count
        spread_m = self._sums(moving**2) - sum_m**2 / count
        flat = (spread_f <= _FLAT) | (spread_m <= _FLAT)
        root = torch.where(flat, torch.ones_like(spread_m), spread_f * spread_m).sqrt()
        product = self._sums(moving * self.fixed) - sum_m * sum_f / count
        return ((1 - torch.where(flat, torch.zeros_like(product), product / root)) * self.weights).sum((-2, -1))

    def _sums(self, maps: Tensor) -> Tensor:
        return maps.sum((-2, -1), keepdim=True) if self.radius is None else patch_sums(maps, self.radius)


def ncc(fixed: Tensor, radius: int | None = None, weights: Tensor | None = None) -> Ncc:
    """NCC against the fixed image (H, W), as a function of moving images (B, H, W).

    Over the whole image, or with `radius` over every patch of (2 · radius + 1)² pixels, averaged, weighted by `weights`
    (H, W) if given. Lewis, Fast normalized cross-correlation, Vision Interface (1995). Raises `InputError` if no patch
    fits, all weights are zero, or weights are given without a radius.
    """
    height, width = fixed.shape
    if radius is None:
        if weights is not None:
            raise InputError("similarity: pixel weights need patches. Give a radius too.")
        return Ncc(fixed.to(torch.float64), torch.ones(1, 1, dtype=torch.float64, device=fixed.device), None)
    if min(height, width) < 2 * radius + 1:
        raise InputError(f"similarity: no patch of radius {radius} fits into a {height} × {width} image.")
    if weights is not None and not (weights > 0).any():
        raise InputError("similarity: all pixel weights are zero; the mask leaves nothing to compare.")
    share = patch_weights(weights, (height, width), radius).to(fixed.device)
    return Ncc(fixed.to(torch.float64), share, radius)
