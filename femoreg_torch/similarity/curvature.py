"""Patch Grad-NCC about one image as a quadratic of pose parameters, for Gauss–Newton steps and for covariances.

With patches scaled to mean 0 and norm 1, 1 − NCC = 1 − f · m has the second derivative −f · d²m. As m keeps its norm,
d²m = −(dm · dm) m + a part across m; without the latter, which no first derivative tells, NCC · (dm)ᵀ(dm) remains: the
Gauss–Newton matrix of ½ ‖f − m‖², damped where the images do not agree yet. The change dm of a scaled patch is that of
the patch less its mean and less its part along the patch itself, divided by the patch's norm. Compare Evangelidis and
Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, IEEE TPAMI 30 (2008) 1858.
The gradient is exact; the curvature is summed over every `_STRIDE`-th patch in both directions.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.similarity.grad_ncc import FLAT, GradNcc
from femoreg_torch.similarity.kernels import image_gradients

_STRIDE = 4
_TILE = 4  # patches along the edge of a tile


def grad_ncc_quadratic(similarity: GradNcc, image: Tensor, jacobian: Tensor) -> tuple[float, Tensor, Tensor]:
    """Cost, gradient by tiles (T, n) and Gauss–Newton hessian (n, n), float64, of an image (H, W).

    `jacobian` (H, W, n) holds the image's derivatives. The gradient is the sum over the tiles, which are larger than a
    patch, so that their shares are nearly independent.
    """
    moving = image[None].clone().requires_grad_()
    cost = similarity(moving)[0]
    (slope,) = torch.autograd.grad(cost, moving)
    changes = jacobian.movedim(-1, 0)  # (n, H, W)
    tile = _TILE * (2 * similarity.radius + 1)
    scores = F.avg_pool2d(changes[:, None] * slope, tile, ceil_mode=True, divisor_override=1).flatten(1).T
    maps = image_gradients(torch.cat([image[None], changes]), similarity.taps)  # (1 + n, 2, H, W)
    hessian = sum(_curvature(similarity, maps[0, d], maps[1:, d], d) for d in range(2))
    assert isinstance(hessian, Tensor)
    return cost.item(), scores.to(torch.float64), hessian / 2  # the cost is the mean over both derivatives


def _curvature(similarity: GradNcc, image: Tensor, changes: Tensor, direction: int) -> Tensor:
    """Σ over patches of weight · NCC · (dm)ᵀ(dm) (n, n) for one derivative map (H, W) and its changes (n, H, W)."""
    side = 2 * similarity.radius + 1
    size = side * side

    def sums(maps: Tensor) -> Tensor:  # (N, H, W) → (N, patches)
        rows = F.avg_pool2d(maps[:, None], (side, 1), (_STRIDE, 1))
        return F.avg_pool2d(rows, (1, side), (1, _STRIDE)).flatten(1) * size

    mean = sums(image[None])[0] / size
    spread = sums(image[None] ** 2)[0] - size * mean**2
    weights = similarity.weights[::_STRIDE, ::_STRIDE].to(image.dtype)
    fixed = similarity.fixed[direction].to(image.dtype)
    product = sums((image * fixed)[None])[0] - mean * sums(fixed[None])[0]
    scale = similarity.scale[direction, ::_STRIDE, ::_STRIDE].flatten().to(image.dtype)  # 0 where flat
    spread = spread.clamp(min=FLAT)
    ncc = (product * scale / spread.sqrt()).clamp(min=0)
    share = weights.flatten() / weights.sum() * ncc / spread
    total = sums(changes)  # Σ dm over each patch
    along = sums(changes * image) - total * mean  # Σ dm (m − mean)
    grid = share.view(1, 1, *weights.shape)
    pixels = F.conv_transpose2d(grid, image.new_ones(1, 1, side, side), stride=_STRIDE)[0, 0]
    pixels = F.pad(pixels, (0, image.shape[1] - pixels.shape[1], 0, image.shape[0] - pixels.shape[0]))
    flat = changes.flatten(1)
    matrix = (flat * pixels.flatten()) @ flat.T
    matrix -= (total * (share / size)) @ total.T
    matrix -= (along * (share / spread)) @ along.T
    return matrix.to(torch.float64)
