"""Derivatives of an image by its pose, from two moments per ray.

A sample lies at x = A u t + b in index space, with the unit ray u, the distance t from the source, the affine (A | b).
For an image I = step · Σ_k V(x_k) the chain rule gives ∂I/∂b = step · Σ ∇V and ∂I/∂A = step · Σ t ∇V uᵀ. So the moments
(step · Σ ∇V, step · Σ t ∇V), six numbers per pixel, hold every derivative with respect to any pose parameter. Where
the samples go along the rays (`drr.sampling`), I changes by step · Σ ∇V · A u per mm.
"""

import torch
from torch import Tensor

from femoreg_torch.geometry.camera import Camera


def unit_rays(camera: Camera, device: torch.device | None = None) -> Tensor:
    """Unit vectors (H, W, 3) float32 from the source through the pixel centres."""
    positions = camera.pixel_positions(device=device)
    return (positions / positions.norm(dim=-1, keepdim=True)).to(torch.float32)


def affine_gradient(moments: Tensor, camera: Camera, upstream: Tensor) -> Tensor:
    """Gradient (B, 3, 4) float64 of Σ upstream · image by the affines; moments (B, H, W, 6), upstream (B, H, W)."""
    rays = unit_rays(camera).flatten(0, 1)
    gradients = []
    for of_pose, weights in zip(moments, upstream, strict=True):  # one by one: all at once would take the memory again
        weighted = (of_pose * weights[..., None]).flatten(0, 1)  # (H · W, 6)
        shift = weighted[:, :3].sum(0, dtype=torch.float64)
        gradients.append(torch.cat([(weighted[:, 3:].mT @ rays).to(torch.float64), shift[:, None]], 1))
    return torch.stack(gradients)


def offset_gradient(moments: Tensor, affines: Tensor, camera: Camera, upstream: Tensor) -> Tensor:
    """Gradient (B,) float64 of Σ upstream · image by the offsets; affines (B, 3, 4), upstream (B, H, W)."""
    directions = torch.einsum("hwj,bij->bhwi", unit_rays(camera), affines[:, :, :3].to(torch.float32))
    return ((moments[..., :3] * directions).sum(-1) * upstream).sum((1, 2), dtype=torch.float64)
