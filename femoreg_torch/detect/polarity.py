"""Whether bone is bright in an image, as it is where attenuation is high, or dark: seen at the rims of the bones."""

import torch
from torch import Tensor
from torch.nn import functional as F

_RIM = 2  # pixels of the segmentation on each side of an outline; 3.1 mm for the shipped network
_AROUND = 9  # pixels to each side that the brightness of the surroundings is taken of
_LEAST_RIM = 50  # pixels; of less than that nothing is said
_QUARTILES = 1.349  # between the quartiles of a normal distribution, in standard deviations
# Of 36 images of another simulator, with steel rails, shutters, wires and bowel gas, by either reading: 0.25 to 1.25
# (by means and deviations instead, those with a rail went down to -0.43); of 12 of this one 0.82 to 1.23. As much below
# zero with their grey values inverted. Seen from the side the network knows no bones: -0.2 to 1.1.
_SURE = 0.1


def rim_contrast(segmentation: Tensor, image: Tensor) -> float:
    """By how many standard deviations bones are brighter just within their outlines than just beyond them.

    `segmentation` (C, h, w) holds probabilities of the background and the bones, `image` (H, W) shows the same field.
    Slow changes of brightness, as of soft tissue and of the beam, are taken off before. By medians and quartiles, so
    that the few pixels along a steel rail, a shutter or a letter do not outweigh the bones. NaN where hardly any
    outline is to be seen.
    """
    bone = (segmentation[1:].sum(0) > 0.5).to(image.dtype)[None, None]
    grey = F.interpolate(image[None, None], size=bone.shape[-2:], mode="area")
    local = grey - F.avg_pool2d(grey, 2 * _AROUND + 1, 1, _AROUND, count_include_pad=False)
    within, beyond = local[bone * _grown(1 - bone) > 0], local[(1 - bone) * _grown(bone) > 0]
    if min(within.numel(), beyond.numel()) < _LEAST_RIM:
        return float("nan")
    lower, upper = torch.cat([within, beyond]).quantile(torch.tensor([0.25, 0.75]).to(grey))
    apart = within.quantile(0.5) - beyond.quantile(0.5)
    return float(apart * _QUARTILES / (upper - lower).clamp_min(1e-12))


def bone_is_dark(segmentation: Tensor, image: Tensor) -> bool | None:
    """Whether the rims of the bones say that bone is darker than what lies around it; None where they do not say."""
    contrast = rim_contrast(segmentation, image)
    return contrast < 0 if abs(contrast) > _SURE else None


def _grown(mask: Tensor) -> Tensor:
    return F.max_pool2d(mask, 2 * _RIM + 1, 1, _RIM)
