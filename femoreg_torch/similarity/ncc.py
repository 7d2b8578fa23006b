"""Normalised cross-correlation of grey values, over the whole image or over patches."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.settings import check_within
from femoreg_torch.similarity.checks import check_image, check_patches, check_size, check_weights, check_whole
from femoreg_torch.similarity.kernels import FLAT, patch_sums, patch_weights


@dataclass(frozen=True)
class Ncc:
    """NCC over the whole image, or with `patch_radius` the mean over every patch of (2 · patch_radius + 1)² pixels.

    Lewis, Fast normalized cross-correlation, Vision Interface (1995).
    """

    patch_radius: int | None = None

    def __post_init__(self) -> None:
        check_whole(self.patch_radius)
        check_within(self, patch_radius=(1, 1000))

    def against(self, fixed: Tensor, weights: Tensor | None = None) -> "FixedNcc | FixedPatchNcc":
        """Prepare with the fixed image (H, W), each pixel weighted by `weights` (H, W) if given.

        Over patches, a patch weighs what its pixels weigh on average. Raises `InputError` if no patch fits or all
        weights are zero.
        """
        return self.inside(None, fixed, weights)

    def inside(self, field: Tensor | None, fixed: Tensor, weights: Tensor | None = None) -> "FixedNcc | FixedPatchNcc":
        """As `against`, by the pixels of `field`, or by the patches wholly within it, see `FieldSimilarity`."""
        check_image(fixed)
        if field is not None and self.patch_radius is None:
            weights = field.to(fixed) if weights is None else weights * field
        check_weights(fixed, weights)
        if self.patch_radius is None:
            return FixedNcc(
                fixed.to(torch.float64), None if weights is None else weights.to(fixed.device, torch.float64)
            )
        check_patches(fixed, self.patch_radius)
        share = patch_weights(weights, (fixed.shape[0], fixed.shape[1]), self.patch_radius, field).to(fixed.device)
        return FixedPatchNcc(fixed.to(torch.float64), share, self.patch_radius)


@dataclass(frozen=True, eq=False)
class FixedNcc:
    """NCC of the whole image against one fixed image; made by `Ncc.against`."""

    fixed: Tensor  # (H, W) float64
    weights: Tensor | None  # (H, W) float64 of the pixels

    def __call__(self, images: Tensor) -> Tensor:
        """Costs 1 − NCC (B,) in [0, 2], float64, of images (B, H, W); a flat image has NCC 0, nan costs nan."""
        check_size(images, self.fixed)
        count = float(self.fixed.numel()) if self.weights is None else self.weights.sum()
        return 1 - _ncc(self.fixed, images.to(torch.float64), self._sums, count)[:, 0, 0]

    def _sums(self, maps: Tensor) -> Tensor:
        return (maps if self.weights is None else maps * self.weights).sum((-2, -1), keepdim=True)


@dataclass(frozen=True, eq=False)
class FixedPatchNcc:
    """Patch NCC against one fixed image; made by `Ncc.against`."""

    fixed: Tensor  # (H, W) float64
    weights: Tensor  # (H − 2r, W − 2r) of the patches, summing to one
    radius: int

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 2], float64, of images (B, H, W): mean 1 − NCC; flat patches have NCC 0, nan costs nan."""
        check_size(images, self.fixed)
        count = float((2 * self.radius + 1) ** 2)
        values = _ncc(self.fixed, images.to(torch.float64), lambda maps: patch_sums(maps, self.radius), count)
        return ((1 - values) * self.weights).sum((-2, -1))


def _ncc(fixed: Tensor, moving: Tensor, sums: Callable[[Tensor], Tensor], count: float | Tensor) -> Tensor:
    """NCC (B, ...) over the regions that `sums` adds up, each of weight `count`."""
    sum_f, sum_m = sums(fixed), sums(moving)
    spread_f = sums(fixed**2) - sum_f**2 / count
    spread_m = sums(moving**2) - sum_m**2 / count
    flat = (spread_f <= FLAT) | (spread_m <= FLAT)
    root = torch.where(flat, torch.ones_like(spread_m), spread_f * spread_m).sqrt()
    product = sums(moving * fixed) - sum_m * sum_f / count
    return torch.where(flat, torch.zeros_like(product), product / root)
