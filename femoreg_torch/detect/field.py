"""Images behind shutters: what the network is shown of them, and which landmarks are believed."""

from dataclasses import replace

import torch
from torch import Tensor

from femoreg_torch.detect.network import Detection


def filled(attenuation: Tensor, field: Tensor) -> Tensor:
    """An image (H, W) with the pixels outside its exposed `field` (H, W), bool, as bright in the beam as any inside.

    The shipped network has seen shutters at the least and at the greatest value of an image. At the greatest, or at the
    mean along the edge of the field, it took one of nine shuttered images for one with bone and background exchanged.
    """
    return attenuation.where(field, attenuation[field].min())


def within_field(detection: Detection, field: Tensor) -> Detection:
    """The detection with no landmark visible that lies outside the exposed `field` (H, W), bool, of the image."""
    columns, rows = detection.pixels.nan_to_num(-1).round().long().T
    height, width = field.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    exposed = inside & field.cpu()[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    return replace(detection, visible=torch.logical_and(detection.visible, exposed))
