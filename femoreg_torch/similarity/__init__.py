"""Image similarities: settings that, prepared with a fixed image, map moving images (B, H, W) to costs (B,)."""

from femoreg_torch.similarity.grad_ncc import GradNcc
from femoreg_torch.similarity.interface import (
    FieldSimilarity,
    FixedSimilarity,
    Similarity,
    SmoothFixedSimilarity,
)
from femoreg_torch.similarity.kernels import derivative_taps, image_gradients
from femoreg_torch.similarity.kinds import read_similarity
from femoreg_torch.similarity.ncc import Ncc
from femoreg_torch.similarity.orientation import GradientOrientation
from femoreg_torch.similarity.quadratic import similarity_quadratic, similarity_quadratics
from femoreg_torch.similarity.shift import even_gradients, shift_correlation
from femoreg_torch.similarity.watched import against_field

__all__ = [
    "FieldSimilarity",
    "FixedSimilarity",
    "GradNcc",
    "GradientOrientation",
    "Ncc",
    "Similarity",
    "SmoothFixedSimilarity",
    "against_field",
    "derivative_taps",
    "even_gradients",
    "image_gradients",
    "read_similarity",
    "shift_correlation",
    "similarity_quadratic",
    "similarity_quadratics",
]
