"""Image similarities: each is prepared with a fixed image and then maps moving images (B, H, W) to costs (B,)."""

from femoreg_torch.similarity.curvature import grad_ncc_quadratic
from femoreg_torch.similarity.grad_ncc import GradNcc, grad_ncc
from femoreg_torch.similarity.ncc import Ncc, ncc
from femoreg_torch.similarity.orientation import GradientOrientation, gradient_orientation

__all__ = ["GradNcc", "GradientOrientation", "Ncc", "grad_ncc", "grad_ncc_quadratic", "gradient_orientation", "ncc"]
