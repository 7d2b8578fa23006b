"""Separable derivative kernels shared by every gradient-based similarity."""

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.similarity import cpu

FLAT = 1e-10  # sum of squared deviations below which a patch counts as flat: line integrals are of order 1


def derivative_taps(smoothing_px: float, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Taps (K,) float64 across and along a derivative: Sobel's [1, 2, 1] / 4 and [−1, 0, 1] / 2, each smoothed.

    `smoothing_px` is the standard deviation of a Gaussian that is folded in (cut at 2 σ, at least 1 px); 0 for none.
    """
    average = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64) / 4
    slope = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) / 2
    if smoothing_px == 0:
        return average.to(device), slope.to(device)
    reach = max(1, math.ceil(2 * smoothing_px - 0.5))
    x = torch.arange(-reach, reach + 1, dtype=torch.float64)
    gauss = torch.exp(-0.5 * (x / smoothing_px) ** 2)
    gauss = gauss / gauss.sum()

    def fold(taps: Tensor) -> Tensor:
        return F.conv1d(taps[None, None], gauss.flip(0)[None, None], padding=2 * reach)[0, 0]

    return fold(average).to(device), fold(slope).to(device)


def image_gradients(images: Tensor, taps: tuple[Tensor, Tensor]) -> Tensor:
    """Derivatives (B, 2, H, W) per pixel, along columns then along rows, of images (B, H, W); edges are replicated.

    `taps` are those of `derivative_taps`; kept on the images' device they need no copy per call. Compiled on the CPU in
    float32 without gradients, else plain torch.
    """
    if images.device.type == "cpu" and images.dtype == torch.float32 and not images.requires_grad:
        averages, slopes = (t.float().numpy() for t in taps)
        return torch.from_numpy(cpu.gradients(images.contiguous().numpy(), averages, slopes))
    average, slope = (t.to(images) for t in taps)
    reach = len(average) // 2
    padded = F.pad(images[:, None], (reach, reach, reach, reach), mode="replicate")
    along_columns = _correlated(_correlated(padded, slope, 3), average, 2)
    along_rows = _correlated(_correlated(padded, average, 3), slope, 2)
    return torch.cat([along_columns, along_rows], 1)


def _correlated(maps: Tensor, taps: Tensor, axis: int) -> Tensor:
    """Maps correlated with taps (K,) along one axis, which becomes K − 1 shorter.

    By sums of shifted maps: GPUs round the factors of a convolution in float32 to ten bits (TF32), unless a switch of
    the whole process says otherwise.
    """
    count = maps.shape[axis] - len(taps) + 1
    return functools.reduce(torch.add, (tap * maps.narrow(axis, k, count) for k, tap in enumerate(taps)))


def patch_sums(maps: Tensor, radius: int) -> Tensor:
    """Sums over all patches of (2r + 1)² pixels that lie wholly inside maps (..., H, W): (..., H − 2r, W − 2r).

    By cumulative sums in float64, so that the cost does not depend on the radius and flat regions stay exact.
    """
    side = 2 * radius + 1
    total = F.pad(maps.to(torch.float64).cumsum(-1), (1, 0))
    total = total[..., side:] - total[..., :-side]
    total = F.pad(total.cumsum(-2), (0, 0, 1, 0))
    return total[..., side:, :] - total[..., :-side, :]


def patch_weights(weights: Tensor | None, shape: tuple[int, int], radius: int, field: Tensor | None = None) -> Tensor:
    """Weights (H − 2r, W − 2r) float64 of the patches, summing to one, from pixel weights (H, W) or equal ones.

    A patch weighs what its pixels weigh on average, and nothing unless it lies wholly in `field` (H, W), bool. Raises
    `InputError` if none does that weighs anything.
    """
    if weights is None:
        weights = torch.ones(shape, device=None if field is None else field.device)
    sums = patch_sums(weights, radius).clamp(min=0)
    if field is not None:
        sums = sums * (patch_sums((~field).float(), radius) < 0.5)
    if not sums.any():
        raise InputError(f"similarity: no patch of radius {radius} lies wholly where there is something to compare.")
    return sums / sums.sum()


def away_from(outside: Tensor, reach: int) -> Tensor:
    """The pixels (H, W), bool, that are more than `reach` pixels away, along rows and columns, from those of a mask."""
    return F.max_pool2d(outside[None].float(), 2 * reach + 1, 1, reach)[0] == 0
