"""Running the network on one image of any camera."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, Anatomy
from femoreg_torch.detect.decode import decode_heatmaps, expected_error
from femoreg_torch.detect.grid import image_from_network, network_camera, to_network_grid
from femoreg_torch.detect.normalise import normalise
from femoreg_torch.detect.polarity import bone_is_dark
from femoreg_torch.detect.tta import AUGMENTATIONS, PLAIN, Augmentation, LogProbabilities, predict
from femoreg_torch.detect.weights import LandmarkNetwork
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera

VISIBLE = 0.5  # confidence from which a landmark counts as seen; the confidences are calibrated, see the model card
# Landmarks by which what an image is read as, turned or inverted, must exceed what it is read as plain.
_MARGIN = 0.5
# Landmarks from which an image may be found to stand on its head. On six of 60 small fields of another simulator a
# turned reading exceeded the plain one, with up to three landmarks, all false, as a shaft looks alike either way.
_LEAST_TURNED = 3.5


@dataclass(frozen=True)
class Detection:
    """What the network sees in an image: L landmarks and C classes, in the order of its anatomy."""

    pixels: Tensor  # (L, 2) float64 column, row in the image that was given
    confidence: Tensor  # (L,) float64 probability of the landmark being there
    deviation_px: Tensor  # (L,) float64 standard deviation to expect of `pixels` along each axis
    visible: Tensor  # (L,) bool
    segmentation: Tensor  # (C, h, w) probabilities of the background and the bones
    network_camera: Camera  # of the segmentation's grid
    turned: bool  # the image was found to stand on its head; all results are for the image as it was given
    inverted: bool = False  # the image was found to have bone dark where attenuation has it bright
    anatomy: Anatomy = HIP  # what the landmarks and the classes are


def detect(
    network: LandmarkNetwork,
    attenuation: Tensor,
    camera: Camera,
    augmentations: tuple[Augmentation, ...] = AUGMENTATIONS,
) -> Detection:
    """Landmarks and bones in an `attenuation` image (H, W) of `camera`: bone bright, patient left on the right.

    The image is read as it is, turned by 180°, and both again with its grey values inverted. The network reads either
    kind of grey values nearly as well, so the mean of the two says which way up the image stands: on its head if it
    expects half a landmark more so, and four (3.5) in one of them; and the rims of the bones that it saw say whether
    bone is dark. What is kept is then read again with test-time augmentation. Raises `InputError` for an image that
    does not fit the camera, holds values that are not finite, or is constant. The network computes where it is; what is
    found lies on the CPU.
    """
    _check(attenuation, camera)
    image = normalise(to_network_grid(attenuation.to(torch.float32), camera)).to(network.device)
    readings = {
        (turned, inverted): predict(network, _oriented(image, turned, inverted), PLAIN).cpu()
        for inverted in (False, True)
        for turned in (False, True)
    }
    turned, inverted = _most_landmarks({key: _expected_landmarks(reading) for key, reading in readings.items()})
    dark = bone_is_dark(readings[turned, inverted].segmentation.softmax(0), _oriented(image, turned, False).cpu())
    inverted = inverted if dark is None else dark
    prediction = predict(network, _oriented(image, turned, inverted), augmentations).cpu()
    positions, confidence = decode_heatmaps(prediction.heatmaps, prediction.absence)
    deviation = expected_error(prediction.heatmaps, positions, network.sigma_px)
    segmentation = prediction.segmentation.softmax(0)
    if turned:
        last = torch.tensor(segmentation.shape[:0:-1], dtype=torch.float64) - 1
        positions, segmentation = last - positions, segmentation.rot90(2, (1, 2))
    grid = network_camera(camera)
    factor = grid.shape[0] // segmentation.shape[1]
    pixels = image_from_network((positions + 0.5) * factor - 0.5, camera)
    size = torch.tensor(camera.shape[::-1], dtype=torch.float64)
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(1)
    return Detection(
        pixels,
        confidence,
        deviation * factor * grid.pixel_mm[0] / float(sum(camera.pixel_mm) / 2),
        (confidence >= VISIBLE) & inside,
        segmentation,
        grid.downsampled(factor),
        turned,
        inverted,
        network.anatomy,
    )


def _oriented(image: Tensor, turned: bool, inverted: bool) -> Tensor:
    image = image.rot90(2) if turned else image
    return -image if inverted else image


def _most_landmarks(expected: Mapping[tuple[bool, bool], float]) -> tuple[bool, bool]:
    """Which reading, (turned, inverted), to keep of those that expect so many landmarks.

    Of 57 upright views of another simulator, of bodies that may train, two were taken to stand on their head; four by
    the best reading alone, one of them an ordinary hip that was read best turned and inverted at once. Turned by 180°,
    none of those that show four landmarks was taken to stand upright, and two by the best reading.
    """
    upright, on_its_head = ((expected[turned, False] + expected[turned, True]) / 2 for turned in (False, True))
    most = max(expected[True, False], expected[True, True])
    turned = on_its_head > upright + _MARGIN and most >= _LEAST_TURNED
    return turned, expected[turned, True] > expected[turned, False] + _MARGIN


def _expected_landmarks(reading: LogProbabilities) -> float:
    """The number of landmarks to expect in an image that was read so."""
    return decode_heatmaps(reading.heatmaps, reading.absence)[1].sum().item()


def _check(image: Tensor, camera: Camera) -> None:
    if tuple(image.shape) != camera.shape:
        raise InputError(
            f"detect: the image is {tuple(image.shape)} (rows, columns), but its camera has {camera.shape}."
        )
    if not torch.isfinite(image).all():
        raise InputError("detect: the image holds values that are not finite. Take -log of positive intensities only.")
    if image.min() == image.max():
        raise InputError(f"detect: every pixel of the image is {image.min().item():g}; nothing can be found in it.")
