"""What a similarity refuses to compare."""

import math
from operator import index

from torch import Tensor

from femoreg_torch.errors import InputError, shortened


def check_whole(patch_radius: int | None) -> None:
    """Raise `InputError` for a radius of patches that is no whole number; None passes."""
    try:
        index(0 if patch_radius is None else patch_radius)
    except TypeError as error:
        raise InputError(f"patch_radius: a whole number was expected, found {shortened(patch_radius)}.") from error


def check_patches(fixed: Tensor, radius: int) -> None:
    """Raise `InputError` if no patch of (2 · radius + 1)² pixels fits into the fixed image (H, W)."""
    height, width = fixed.shape
    if min(height, width) < 2 * radius + 1:
        raise InputError(f"similarity: no patch of radius {radius} fits into a {height} × {width} image.")


def check_image(fixed: Tensor) -> None:
    """Raise `InputError` for a fixed image that is no tensor (H, W) of floating-point numbers."""
    if not isinstance(fixed, Tensor):
        raise InputError(
            f"similarity: the fixed image must be a torch tensor, got {type(fixed).__name__}. Use torch.as_tensor."
        )
    if fixed.ndim != 2:
        raise InputError(f"similarity: a fixed image of shape (H, W) was expected, got {tuple(fixed.shape)}.")
    _check_floating("the fixed image holds", fixed)


def _check_floating(what: str, image: Tensor) -> None:
    """Whole numbers would be smoothed and differentiated as whole numbers."""
    if not image.is_floating_point():
        raise InputError(f"similarity: {what} {image.dtype}, floating-point numbers were expected. Use `.float()`.")


def check_weights(fixed: Tensor, weights: Tensor | None) -> None:
    """Raise `InputError` for pixel weights that are not of the fixed image's size (H, W), or none, or all zero."""
    if weights is None:
        return
    if weights.shape != fixed.shape:
        raise InputError(f"similarity: weights are {tuple(weights.shape)}, the fixed image {tuple(fixed.shape)}.")
    if not bool(((weights >= 0) & (weights < math.inf)).all()):
        raise InputError("similarity: pixel weights must be finite and not negative.")
    if not (weights > 0).any():
        raise InputError("similarity: all pixel weights are zero; the mask leaves nothing to compare.")


def check_size(images: Tensor, fixed: Tensor) -> None:
    """Raise `InputError` for images (B, H, W) of another size than the fixed one (..., H, W), or of whole numbers."""
    if images.shape[1:] != fixed.shape[-2:]:
        raise InputError(f"similarity: images are {tuple(images.shape[1:])}, the fixed one {tuple(fixed.shape[-2:])}.")
    _check_floating("images hold", images)
