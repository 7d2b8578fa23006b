"""Where an image is as bright as its file, or its detector, can tell: more light would look the same."""

import torch
from torch import Tensor

_LEAST_SHARE = 0.02  # of what is exposed; less is a hot spot, or letters
_LETTERS = 0.01  # share that may be brighter still: what was written into the image
_ABOVE_ITS_LIKE = 3.0  # as many pixels as of the next grey value: noise leaves no such step unless light is cut off
_ROUNDING = 4e-6  # of a logarithm: less than a step of 16 bits at the brightest


def saturated(attenuation: Tensor, field: Tensor | None = None) -> Tensor | None:
    """The saturated pixels (H, W), bool, of an attenuation image, bone bright; None where it is not cut off.

    Many pixels of exactly one value tell it, which hardly any other exceeds, and far more than of the value next to it.
    Only what is exposed, `field` (H, W), bool, is asked; None: all of it.
    """
    values = attenuation.flatten() if field is None else attenuation[field]
    count = len(values)
    if not count:
        return None
    level = values.kthvalue(1 + int(_LETTERS * count)).values
    most = level + _ROUNDING * level.abs().clamp_min(1)
    at_most, darker = int((values <= most).count_nonzero()), values[values > most]
    if at_most < _LEAST_SHARE * count:
        return None
    if len(darker):
        following = darker.amin()
        alike = darker <= following + _ROUNDING * following.abs().clamp_min(1)
        if at_most < _ABOVE_ITS_LIKE * int(torch.count_nonzero(alike)):
            return None
    return attenuation <= most
