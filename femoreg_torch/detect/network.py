"""Running the network on one image of any camera."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from femoreg_torch.detect.decode import decode_heatmaps
from femoreg_torch.detect.grid import image_from_network, network_camera, to_network_grid
from femoreg_torch.detect.normalise import normalise
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera

VISIBLE = 0.4  # confidence from which a landmark counts as seen; chosen on the patient that validated the training


@dataclass(frozen=True)
class Detection:
    """What the network sees in an image. Landmarks are in the order of `HIP_LANDMARKS`."""

    pixels: Tensor  # (14, 2) float64 column, row in the image that was given
    confidence: Tensor  # (14,) float64 probability of the landmark being there
    visible: Tensor  # (14,) bool
    segmentation: Tensor  # (7, h, w) probabilities of background and bones 1 to 6
    network_camera: Camera  # of the segmentation's grid
    turned: bool  # the image was found to stand on its head; all results are for the image as it was given


def load_network(path: Path | None = None) -> nn.Module:
    """The network of a weights file in evaluation mode; without a path, the shipped one. Raises `InputError`."""
    from models.weights import load_weights

    try:
        return load_weights(path)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error


def detect(network: nn.Module, attenuation: Tensor, camera: Camera) -> Detection:
    """Landmarks and bones in an `attenuation` image (H, W) of `camera`: bone bright, patient left on the right.

    The image is looked at as it is and turned by 180°, and the reading of the higher total confidence is taken. Raises
    `InputError` for an image that does not fit the camera, holds values that are not finite, or is constant.
    """
    _check(attenuation, camera)
    image = normalise(to_network_grid(attenuation.to(torch.float32), camera))
    readings = [_read(network, image), _read(network, image.rot90(2))]
    turned = readings[1][1].sum().item() > readings[0][1].sum().item()
    positions, confidence, segmentation = readings[int(turned)]
    if turned:
        last = torch.tensor(segmentation.shape[:0:-1], dtype=torch.float64) - 1
        positions, segmentation = last - positions, segmentation.rot90(2, (1, 2))
    grid = network_camera(camera)
    factor = grid.shape[0] // segmentation.shape[1]
    pixels = image_from_network((positions + 0.5) * factor - 0.5, camera)
    size = torch.tensor(camera.shape[::-1], dtype=torch.float64)
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(1)
    return Detection(
        pixels, confidence, (confidence >= VISIBLE) & inside, segmentation, grid.downsampled(factor), turned
    )


def _check(image: Tensor, camera: Camera) -> None:
    if tuple(image.shape) != camera.shape:
        raise InputError(
            f"detect: the image is {tuple(image.shape)} (rows, columns), but its camera has {camera.shape}."
        )
    if not torch.isfinite(image).all():
        raise InputError("detect: the image holds values that are not finite. Take -log of positive intensities only.")
    if image.min() == image.max():
        raise InputError(f"detect: every pixel of the image is {image.min().item():g}; nothing can be found in it.")


@torch.inference_mode()
def _read(network: nn.Module, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (14, 2) on the output's grid, confidences (14,) and class probabilities of an image on the grid."""
    prediction = network(image[None, None])
    positions, confidence = decode_heatmaps(prediction.heatmaps[0], prediction.absence[0])
    return positions, confidence, prediction.segmentation[0].softmax(0)
