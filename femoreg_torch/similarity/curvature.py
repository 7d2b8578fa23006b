"""Curvature of patch NCC about one image, for Gauss–Newton steps and for covariances.

With patches scaled to mean 0 and norm 1, 1 − NCC = 1 − f · m has the second derivative −f · d²m. As m keeps its norm,
d²m = −(dm · dm) m + a part across m; without the latter, which no first derivative tells, NCC · (dm)ᵀ(dm) remains: the
Gauss–Newton matrix of ½ ‖f − m‖², damped where the images do not agree yet. The change dm of a scaled patch is that of
the patch less its mean and less its part along the patch itself, divided by the patch's norm. Compare Evangelidis and
Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, IEEE TPAMI 30 (2008) 1858.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.similarity.kernels import FLAT


def patch_curvature(
    image: Tensor, changes: Tensor, fixed: Tensor, scale: Tensor, weights: Tensor, radius: int, stride: int
) -> Tensor:
    """Σ over patches of weight · NCC · (dm)ᵀ(dm) (n, n), float64, for an image (H, W) and its changes (n, H, W).

    `fixed` is (H, W); `scale` and `weights` (H − 2r, W − 2r) are 1 / √Σ(f − mean)² of each fixed patch, 0 where it is
    flat, and what it weighs. Every `stride`-th patch in both directions is summed, with weights that sum to one.
    """
    side = 2 * radius + 1
    size = side * side

    def sums(maps: Tensor) -> Tensor:  # (N, H, W) → (N, patches)
        rows = F.avg_pool2d(maps[:, None], (side, 1), (stride, 1))
        return F.avg_pool2d(rows, (1, side), (1, stride)).flatten(1) * size

    mean = sums(image[None])[0] / size
    spread = sums(image[None] ** 2)[0] - size * mean**2
    weights = weights[::stride, ::stride].to(image.dtype)
    fixed = fixed.to(image.dtype)
    product = sums((image * fixed)[None])[0] - mean * sums(fixed[None])[0]
    scale = scale[::stride, ::stride].flatten().to(image.dtype)
    spread = spread.clamp(min=FLAT)
    ncc = (product * scale / spread.sqrt()).clamp(min=0)
    share = weights.flatten() / weights.sum() * ncc / spread
    total = sums(changes)  # Σ dm over each patch
    along = sums(changes * image) - total * mean  # Σ dm (m − mean)
    grid = share.view(1, 1, *weights.shape).to(torch.float64)  # or a GPU rounds it to ten bits
    pixels = F.conv_transpose2d(grid, grid.new_ones(1, 1, side, side), stride=stride)[0, 0].to(image.dtype)
    pixels = F.pad(pixels, (0, image.shape[1] - pixels.shape[1], 0, image.shape[0] - pixels.shape[0]))
    flat = changes.flatten(1)
    matrix = (flat * pixels.flatten()) @ flat.T
    matrix -= (total * (share / size)) @ total.T
    matrix -= (along * (share / spread)) @ along.T
    return matrix.to(torch.float64)
