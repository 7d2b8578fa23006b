"""The grey values that the network expects."""

import torch
from torch import Tensor


def normalise(images: Tensor) -> Tensor:
    """Each image (..., H, W) shifted and scaled to mean 0 and standard deviation 1."""
    mean = images.mean((-2, -1), keepdim=True)
    deviation = images.std((-2, -1), keepdim=True)
    return (images - mean) / deviation.clamp_min(torch.finfo(images.dtype).tiny)
