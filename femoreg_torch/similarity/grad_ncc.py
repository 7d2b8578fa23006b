"""Patch-wise normalised cross-correlation of image gradients, the similarity of the paper."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.derivatives import first_order
from femoreg_torch.settings import check_within
from femoreg_torch.similarity import cpu, cuda
from femoreg_torch.similarity.checks import check_image, check_patches, check_size, check_weights, check_whole
from femoreg_torch.similarity.curvature import patch_curvature
from femoreg_torch.similarity.kernels import (
    FLAT,
    away_from,
    derivative_taps,
    image_gradients,
    patch_sums,
    patch_weights,
)
from femoreg_torch.similarity.quadratic import tile_scores

_TILE = 4  # patches along the edge of a tile: so large that the tiles' shares are nearly independent
_STRIDE = 4  # the curvature is summed over every so many-th patch in both directions


@dataclass(frozen=True)
class GradNcc:
    """Patch Grad-NCC: both images are smoothed by a Gaussian of `smoothing_px` and differentiated by Sobel.

    NCC is taken over every patch of (2 · patch_radius + 1)² pixels that lies wholly inside, and averaged over patches,
    weighted, and over both derivatives. A patch that is flat in either image has NCC 0: its squared deviations sum up
    to less than 1e-10, for line integrals, which are of order 1. xReg:
    xregImgSimMetric2DPatchGradNCC (smoothing 1.1 px is its 5 × 5 kernel); Grupp et al., IEEE TBME 67 (2020) 441.
    """

    patch_radius: int = 5
    smoothing_px: float = 1.1

    def __post_init__(self) -> None:
        check_whole(self.patch_radius)
        check_within(self, patch_radius=(1, 1000), smoothing_px=(0, 100))

    def against(self, fixed: Tensor, weights: Tensor | None = None) -> "FixedGradNcc":
        """Prepare with the fixed image (H, W); a patch weighs what its pixels' `weights` (H, W) are on average.

        Raises `InputError` if no patch fits or all weights are zero.
        """
        return self.inside(None, fixed, weights)

    def inside(self, field: Tensor | None, fixed: Tensor, weights: Tensor | None = None) -> "FixedGradNcc":
        """As `against`, by the patches whose derivatives need no pixel outside `field`, see `FieldSimilarity`."""
        check_image(fixed)
        radius = self.patch_radius
        check_patches(fixed, radius)
        check_weights(fixed, weights)
        taps = derivative_taps(self.smoothing_px, fixed.device)
        maps = image_gradients(fixed[None], taps)[0]
        n = (2 * radius + 1) ** 2
        mean = patch_sums(maps, radius) / n
        spread = patch_sums(maps**2, radius) - n * mean**2
        scale = torch.where(spread > FLAT, spread.clamp(min=FLAT).rsqrt(), torch.zeros_like(spread))
        kept = None if field is None else away_from(~field, len(taps[0]) // 2)
        share = patch_weights(weights, (fixed.shape[0], fixed.shape[1]), radius, kept).to(mean.device)
        return FixedGradNcc(maps, mean, scale, share, radius, taps)


@dataclass(frozen=True, eq=False)
class FixedGradNcc:
    """Patch Grad-NCC against one fixed image; made by `GradNcc.against`."""

    fixed: Tensor  # (2, H, W) derivatives
    mean: Tensor  # (2, H − 2r, W − 2r) of each fixed patch
    scale: Tensor  # (2, H − 2r, W − 2r): 1 / √Σ(f − mean)², 0 where flat
    weights: Tensor  # (H − 2r, W − 2r), summing to one
    radius: int
    taps: tuple[Tensor, Tensor]  # of the derivative, see `derivative_taps`

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 2] of images (B, H, W), float64: mean over patches and both derivatives of 1 − NCC.

        Images that hold nan cost nan, and so does everything against a fixed one that does.
        """
        check_size(images, self.fixed)
        if images.device.type == "cpu" and images.dtype == torch.float32:
            value: Tensor = _CpuGradNcc.apply(images, self)
        elif cuda.runs(images):
            value = _CudaGradNcc.apply(images, self)
        else:
            value = self._reference(images)
        return 1 - value

    @cached_property
    def tap_tables(self) -> Tensor:
        """`taps` (2, 3, K) float32 where the images are: inside, at the first and at the last row or column.

        At an edge the image goes on as it ends there. So a pixel of the edge counts for all that lie beyond it as well:
        its tap is the sum of theirs.
        """
        taps = torch.stack(self.taps)
        return torch.stack([taps, taps.cumsum(1), taps.flip(1).cumsum(1).flip(1)], 1).float()

    def quadratic(self, image: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (), scores (T, n), Gauss–Newton hessian (n, n), see `SmoothFixedSimilarity`; the gradient is exact."""
        cost, slope = self._with_slope(image)
        changes = jacobian.movedim(-1, 0)  # (n, H, W)
        scores = tile_scores(changes, slope, _TILE * (2 * self.radius + 1))
        return cost, scores, self.curvature(image, changes, _STRIDE)

    def _with_slope(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Cost () of an image (H, W), and its derivative (1, H, W) by the image."""
        if image.device.type == "cpu" and image.dtype == torch.float32:
            check_size(image[None], self.fixed)
            value, slope = cpu.grad_ncc_and_gradient(image.contiguous().numpy(), *_CpuGradNcc._arguments(self))
            return torch.tensor(1 - value, dtype=torch.float64), -torch.from_numpy(slope)[None]
        if cuda.runs(image):
            check_size(image[None], self.fixed)
            values, slopes = cuda.grad_ncc_and_gradient(image[None], self)
            return 1 - values[0], -slopes
        moving = image[None].clone().requires_grad_()
        cost = self(moving)[0]
        (derivative,) = torch.autograd.grad(cost, moving)
        return cost.detach(), derivative

    def curvature(self, image: Tensor, changes: Tensor, stride: int) -> Tensor:
        """Gauss–Newton hessian (n, n) float64 about an image (H, W) with changes (n, H, W); every stride-th patch."""
        if image.device.type == "cpu" and image.dtype == changes.dtype == torch.float32:
            average, slope = (taps.float().numpy() for taps in self.taps)
            numbers = (t.contiguous().numpy() for t in (image, changes, self.fixed, self.scale, self.weights))
            factors = cpu.curvature_factors(*numbers, self.radius, stride, FLAT, average, slope)
            of_pixels, of_means, along = (torch.from_numpy(factor).flatten(1) for factor in factors)
            both = of_pixels @ of_pixels.T - of_means @ of_means.T - along @ along.T
            return both.to(torch.float64) / 2  # the cost is the mean over both derivatives
        if cuda.runs(image) and cuda.runs(changes):
            return cuda.curvature(image, changes, self, stride)
        maps = image_gradients(torch.cat([image[None], changes]), self.taps)  # (1 + n, 2, H, W)
        along_columns, along_rows = (
            patch_curvature(maps[0, d], maps[1:, d], self.fixed[d], self.scale[d], self.weights, self.radius, stride)
            for d in range(2)
        )
        return (along_columns + along_rows) / 2

    def _reference(self, images: Tensor) -> Tensor:
        """Weighted mean NCC (B,) in plain torch."""
        moving = image_gradients(images, self.taps)
        n = (2 * self.radius + 1) ** 2
        sums = patch_sums(moving, self.radius)
        spread = patch_sums(moving**2, self.radius) - sums**2 / n
        flat = spread <= FLAT
        root = torch.where(flat, torch.ones_like(spread), spread).sqrt()
        product = patch_sums(moving * self.fixed, self.radius) - sums * self.mean
        ncc = torch.where(flat, torch.zeros_like(product), product * self.scale / root)
        return (ncc * self.weights).sum((-2, -1)).mean(-1)


class _CpuGradNcc(torch.autograd.Function):
    """The compiled weighted mean NCC (B,) of images (B, H, W)."""

    @staticmethod
    def _arguments(similarity: FixedGradNcc) -> tuple[Any, ...]:
        average, slope = (taps.float().numpy() for taps in similarity.taps)
        numbers = (t.numpy() for t in (similarity.fixed, similarity.mean, similarity.scale, similarity.weights))
        return *numbers, similarity.radius, FLAT, average, slope

    @staticmethod
    def forward(ctx: Any, images: Tensor, similarity: FixedGradNcc) -> Tensor:
        ctx.save_for_backward(images)
        ctx.similarity = similarity
        values = cpu.grad_ncc(images.detach().contiguous().numpy(), *_CpuGradNcc._arguments(similarity))
        return torch.from_numpy(values).mean(-1)

    @staticmethod
    @first_order("a cost of GradNcc")
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (images,) = ctx.saved_tensors
        arguments = _CpuGradNcc._arguments(ctx.similarity)
        gradient = cpu.grad_ncc_gradient(images.detach().contiguous().numpy(), *arguments, upstream.double().numpy())
        return torch.from_numpy(gradient), None


class _CudaGradNcc(torch.autograd.Function):
    """The weighted mean NCC (B,) of images (B, H, W) by Triton."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, similarity: FixedGradNcc) -> Tensor:
        if not ctx.needs_input_grad[0]:
            return cuda.grad_ncc(images, similarity)
        values, gradient = cuda.grad_ncc_and_gradient(images, similarity)
        ctx.save_for_backward(gradient, images)
        return values

    @staticmethod
    @first_order("a cost of GradNcc")
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        gradient, _ = ctx.saved_tensors
        return upstream.to(gradient)[:, None, None] * gradient, None
