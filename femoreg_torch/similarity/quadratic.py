"""Any similarity about one image as a quadratic of pose parameters.

For those without a formula of their own: the gradient by automatic differentiation, and as curvature Jᵀ (∂²c/∂I²) J by
differentiating twice, where J are the derivatives of the image I by the parameters: the generalised Gauss–Newton matrix
(Schraudolph, Fast curvature matrix-vector products for second-order gradient descent, Neural Computation 14 (2002)
1723). Where the similarity is not convex its eigenvalues are replaced by their absolute values (Dauphin et al.,
Identifying and attacking the saddle point problem in high-dimensional non-convex optimization, NeurIPS 2014).
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.similarity import cpu, cuda
from femoreg_torch.similarity.interface import FixedSimilarity, SmoothFixedSimilarity
from femoreg_torch.similarity.watched import gave_nan, similarity_name, watched

_TILE_PX = 44  # edge of a tile; as that of Grad-NCC with patches of radius 5


def similarity_quadratic(similarity: FixedSimilarity, image: Tensor, jacobian: Tensor) -> tuple[float, Tensor, Tensor]:
    """Cost, scores (T, n) and positive semi-definite hessian (n, n), float64, of a similarity about an image (H, W).

    `jacobian` (H, W, n) holds the image's derivatives, see `SmoothFixedSimilarity`. Scores and hessian lie on the CPU,
    wherever the image is. Raises `InputError` for a similarity that cannot be differentiated twice, has no curvature,
    or gives nan.
    """
    return similarity_quadratics([lambda: (similarity, image, jacobian)], image.device)[0]


def similarity_quadratics(
    about: Sequence[Callable[[], tuple[FixedSimilarity, Tensor, Tensor]]], device: torch.device
) -> list[tuple[float, Tensor, Tensor]]:
    """`similarity_quadratic` of several similarities, each with its image and jacobian, which a function gives.

    On the CPU, several are worked on at a time; another `device` is waited for once.
    """

    def there(
        given: Callable[[], tuple[FixedSimilarity, Tensor, Tensor]],
    ) -> tuple[FixedSimilarity, tuple[Tensor | float, Tensor, Tensor]]:
        similarity, image, jacobian = given()
        if isinstance(similarity, SmoothFixedSimilarity):
            return similarity, similarity.quadratic(image, jacobian)
        return similarity, _differentiated(similarity, image, jacobian)

    found = on_all_cores(there, about, device)
    return [
        (cost, scores, _checked(similarity, cost, scores, hessian))
        for (similarity, _), (cost, scores, hessian) in zip(found, _on_the_cpu([f for _, f in found]), strict=True)
    ]


def _on_the_cpu(found: Sequence[tuple[Tensor | float, Tensor, Tensor]]) -> list[tuple[float, Tensor, Tensor]]:
    """Costs, scores and hessians there, all by one copy."""
    if all(scores.device.type == hessian.device.type == "cpu" for _, scores, hessian in found):
        return [(float(cost), scores, hessian) for cost, scores, hessian in found]
    flat = []
    for cost, scores, hessian in found:
        flat += [scores.new_full((1,), cost) if isinstance(cost, float) else cost.reshape(1), scores, hessian]
    parts = torch.cat([part.to(torch.float64).flatten() for part in flat]).cpu().split([part.numel() for part in flat])
    return [
        (float(cost), scores.view(there.shape), hessian.view(there.shape[1], -1))
        for cost, scores, hessian, (_, there, _) in zip(parts[::3], parts[1::3], parts[2::3], found, strict=True)
    ]


def _differentiated(similarity: FixedSimilarity, image: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (), scores (T, n) and second derivatives (n, n) by differentiating a similarity twice."""
    moving = image[None].clone().requires_grad_()
    changes = jacobian.movedim(-1, 0)  # (n, H, W)
    cost = watched(similarity, similarity)(moving)[0]
    if not cost.requires_grad:
        raise _not_smooth(similarity, "its costs carry no derivatives by the images")
    try:
        slope = _slope(cost, moving, again=True)
        along = (changes * slope).sum((1, 2))  # (n,): the gradient
        bent = [_slope(part, moving, again=False) for part in along]  # Hessian-vector products
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise _not_smooth(similarity, f"it cannot be differentiated twice ({reason})") from error
    scores = tile_scores(changes, slope.detach(), _TILE_PX)
    hessian = changes.flatten(1).to(torch.float64) @ torch.cat(bent).flatten(1).to(torch.float64).T
    return cost.detach(), scores, hessian


def _slope(value: Tensor, moving: Tensor, *, again: bool) -> Tensor:
    """Derivative (1, H, W) of a value () by an image (1, H, W), maybe to be differentiated again; 0 of a constant."""
    if not value.requires_grad:
        return torch.zeros_like(moving)
    slopes = torch.autograd.grad(value, moving, retain_graph=True, create_graph=again)
    return slopes[0]


def _checked(similarity: FixedSimilarity, cost: float, scores: Tensor, hessian: Tensor) -> Tensor:
    """A hessian without negative curvature. Raises `InputError` for a cost or derivatives that are none.

    A similarity that knows its own derivatives is believed.
    """
    if math.isnan(cost):
        raise gave_nan(similarity)
    if isinstance(similarity, SmoothFixedSimilarity):
        return hessian
    if not (torch.isfinite(hessian).all() and torch.isfinite(scores).all()):
        raise _not_smooth(similarity, "its derivatives are not finite")
    if scores.any() and not hessian.any():
        raise _not_smooth(similarity, "its second derivative is zero")
    return _without_negative_curvature(hessian)


def tile_scores(changes: Tensor, slope: Tensor, tile: int) -> Tensor:
    """The gradient by square tiles, (T, n) float64: of an image that changes by (n, H, W) and slopes by (1, H, W)."""
    if changes.device.type == "cpu" and changes.dtype == slope.dtype == torch.float32:
        return torch.from_numpy(cpu.tile_sums(changes.contiguous().numpy(), slope[0].contiguous().numpy(), tile)).T
    if cuda.runs(changes) and cuda.runs(slope):
        return cuda.tile_sums(changes, slope[0], tile).T
    return (
        F.avg_pool2d(changes[:, None] * slope, tile, ceil_mode=True, divisor_override=1).flatten(1).T.to(torch.float64)
    )


def _without_negative_curvature(hessian: Tensor) -> Tensor:
    """The same eigenvectors with the absolute values of the eigenvalues, (n, n)."""
    values, vectors = torch.linalg.eigh((hessian + hessian.T) / 2)
    return (vectors * values.abs()) @ vectors.T


def _not_smooth(similarity: FixedSimilarity, reason: str) -> InputError:
    return InputError(
        f"similarity {similarity_name(similarity)}: {reason}, and Levenberg–Marquardt needs slope and curvature. "
        "Choose an optimiser without derivatives, such as cma_es or bobyqa, or give it a `quadratic` of its own."
    )
