"""Image similarities: each is prepared with a fixed image and then maps moving images (B, H, W) to costs (B,)."""

from femoreg_torch.similarity.grad_ncc import GradNcc, grad_ncc

__all__ = ["GradNcc", "grad_ncc"]
