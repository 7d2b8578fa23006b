"""Patch-wise normalised cross-correlation of image gradients, the similarity of the paper."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from femoreg_torch.errors import InputError
from femoreg_torch.similarity import cpu
from femoreg_torch.similarity.kernels import derivative_taps, image_gradients, patch_sums, patch_weights

FLAT = 1e-10  # sum of squared deviations below which a patch counts as flat: line integrals are of order 1


@dataclass(frozen=True, eq=False)
class GradNcc:
    """Patch Grad-NCC against one fixed image; made by `grad_ncc`."""

    fixed: Tensor  # (2, H, W) derivatives
    mean: Tensor  # (2, H − 2r, W − 2r) of each fixed patch
    scale: Tensor  # (2, H − 2r, W − 2r): 1 / √Σ(f − mean)², 0 where flat
    weights: Tensor  # (H − 2r, W − 2r), summing to one
    radius: int
    taps: tuple[Tensor, Tensor]  # of the derivative, see `derivative_taps`

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 2] of images (B, H, W), float64: mean over patches and both derivatives of 1 − NCC."""
        if images.shape[1:] != self.fixed.shape[1:]:
            raise InputError(
                f"similarity: images are {tuple(images.shape[1:])}, the fixed one {tuple(self.fixed.shape[1:])}."
            )
        if images.device.type == "cpu" and images.dtype == torch.float32:
            value: Tensor = _CpuGradNcc.apply(images, self)
        else:
            value = self._reference(images)
        return 1 - value

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


def grad_ncc(fixed: Tensor, radius: int, smoothing_px: float = 1.1, weights: Tensor | None = None) -> GradNcc:
    """Patch Grad-NCC against the fixed image (H, W), as a function of moving images (B, H, W).

    Both images are smoothed by a Gaussian of `smoothing_px` and differentiated by Sobel; NCC is taken over every
    patch of (2 · radius + 1)² pixels that lies wholly inside, and averaged, weighted by `weights` (H, W) if given. A
    patch that is flat in either image has NCC 0. xReg: xregImgSimMetric2DPatchGradNCC (smoothing 1.1 px is its 5 × 5
    kernel); Grupp et al., IEEE TBME 67 (2020) 441. Raises `InputError` if no patch fits or all weights are zero.
    """
    height, width = fixed.shape
    if min(height, width) < 2 * radius + 1:
        raise InputError(f"similarity: no patch of radius {radius} fits into a {height} × {width} image.")
    if weights is not None and not (weights > 0).any():
        raise InputError("similarity: all pixel weights are zero; the mask leaves nothing to compare.")
    taps = derivative_taps(smoothing_px, fixed.device)
    maps = image_gradients(fixed[None], taps)[0]
    n = (2 * radius + 1) ** 2
    mean = patch_sums(maps, radius) / n
    spread = patch_sums(maps**2, radius) - n * mean**2
    scale = torch.where(spread > FLAT, spread.clamp(min=FLAT).rsqrt(), torch.zeros_like(spread))
    share = patch_weights(weights, (height, width), radius).to(mean.device)
    return GradNcc(maps, mean, scale, share, radius, taps)


class _CpuGradNcc(torch.autograd.Function):
    """The compiled weighted mean NCC (B,) of images (B, H, W)."""

    @staticmethod
    def _arguments(similarity: GradNcc) -> tuple[Any, ...]:
        average, slope = (taps.float().numpy() for taps in similarity.taps)
        numbers = (t.numpy() for t in (similarity.fixed, similarity.mean, similarity.scale, similarity.weights))
        return *numbers, similarity.radius, FLAT, average, slope

    @staticmethod
    def forward(ctx: Any, images: Tensor, similarity: GradNcc) -> Tensor:
        ctx.save_for_backward(images)
        ctx.similarity = similarity
        values = cpu.grad_ncc(images.detach().contiguous().numpy(), *_CpuGradNcc._arguments(similarity))
        return torch.from_numpy(values).mean(-1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (images,) = ctx.saved_tensors
        arguments = _CpuGradNcc._arguments(ctx.similarity)
        gradient = cpu.grad_ncc_gradient(images.detach().contiguous().numpy(), *arguments, upstream.double().numpy())
        return torch.from_numpy(gradient), None
