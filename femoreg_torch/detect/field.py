"""Images behind shutters, or stored in other ways: what the network is shown of them, and what is believed."""

from dataclasses import replace

import torch
from torch import Tensor

from femoreg_torch.detect.network import Detection
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera


def filled(attenuation: Tensor, field: Tensor) -> Tensor:
    """An image (H, W) with the pixels outside its exposed `field` (H, W), bool, as bright in the beam as any inside.

    The shipped network has seen shutters at the least and at the greatest value of an image. At the greatest, or at the
    mean along the edge of the field, it took one of nine shuttered images for one with bone and background exchanged.
    """
    return attenuation.where(field, attenuation[field].min())


def as_stored(detection: Detection, display: Display, camera: Camera) -> Detection:
    """What was found in an image of `camera`, as places in the picture that is stored as `display` says."""
    return replace(
        detection,
        pixels=display.pixels_to_stored(detection.pixels, camera),
        segmentation=display.to_stored(detection.segmentation),
        network_camera=display.stored_camera(detection.network_camera),
    )


def within_field(detection: Detection, field: Tensor) -> Detection:
    """The detection with no landmark visible that lies outside the exposed `field` (H, W), bool, of the image."""
    columns, rows = detection.pixels.nan_to_num(-1).round().long().T
    height, width = field.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    exposed = inside & field.cpu()[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    return replace(detection, visible=torch.logical_and(detection.visible, exposed))
