"""How well a network reads one image of a patient it has not seen: landmarks, bones, and the start pose.

An image is read as `femoreg detect` reads it. A landmark counts as found if it is visible to `detect`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import Detection, LandmarkNetwork, as_stored, detect
from femoreg_torch.detect.tta import AUGMENTATIONS, Augmentation
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display, Source
from femoreg_torch.geometry import rotation_angle, transform_points
from femoreg_torch.registration.start.find import find_start
from training.augmentation import inside
from training.labelled import LabelledImage

Array = NDArray[np.float64]
Registration = Callable[[LabelledImage, Tensor], Tensor]  # from an image and a start pose (4, 4) to a pose (4, 4)

_LEAST_VISIBLE = 6  # landmarks in an image that a start pose is asked of


@dataclass(frozen=True, eq=False)
class Reading:
    """What became of one image; L landmarks and B bones of the hip, in order."""

    patient: str
    error_mm: Array  # (L,) on the detector
    found: NDArray[np.bool_]  # (L,)
    visible: NDArray[np.bool_]  # (L,) truly in the image
    confidence: Array  # (L,)
    overlap: Array  # (B, 2): 2 |A ∩ B| and |A| + |B| in pixels
    asked: bool  # whether a start pose was asked for
    refused: bool  # whether it was asked for and none was given
    pose_error: Array  # (3,) degrees, mm across, mm in depth at the landmarks' middle; nan without a pose
    registered_error: Array | None = None  # (3,) the same after single-view registration, if it was run
    source: Source = "anterior"  # the side of the patient that it stood on


def read_images(
    network: LandmarkNetwork,
    images: Iterable[LabelledImage],
    augmentations: tuple[Augmentation, ...] = AUGMENTATIONS,
    register: Registration | None = None,
) -> list[Reading]:
    """Detect in each image, find its start pose where enough landmarks are in it, and then `register` it."""
    return [_read(_look(network, image, augmentations), image, register) for image in images]


def _look(network: LandmarkNetwork, image: LabelledImage, augmentations: tuple[Augmentation, ...]) -> Detection:
    """What the network sees; it is shown the patient's left on the right."""
    if not image.display.left_on_left:
        return detect(network, image.attenuation, image.camera, augmentations)
    camera = image.camera.mirrored()
    found = detect(network, image.attenuation.flip(-1), camera, augmentations)
    return as_stored(found, Display(mirrored=True), camera)


def _read(detection: Detection, image: LabelledImage, register: Registration | None) -> Reading:
    pixel_mm = torch.tensor(image.camera.pixel_mm[::-1], dtype=torch.float64)
    error = ((detection.pixels - image.landmarks) * pixel_mm).norm(dim=1)
    there = image.visible & inside(image.landmarks, image.camera.shape)
    asked = image.posed and int(there.sum()) >= _LEAST_VISIBLE
    start = _start(detection, image) if asked else None
    registered = register(image, start) if register is not None and start is not None else None
    return Reading(
        patient=image.patient,
        source=image.display.source,
        error_mm=error.numpy(),
        found=detection.visible.numpy(),
        visible=there.numpy(),
        confidence=detection.confidence.numpy(),
        overlap=_overlap(detection.segmentation, image.labels),
        asked=asked,
        refused=asked and start is None,
        pose_error=_pose_error(start, image),
        registered_error=None if register is None else _pose_error(registered, image),
    )


def _overlap(segmentation: Tensor, labels: Tensor) -> Array:
    """2 |A ∩ B| and |A| + |B| (B, 2) in pixels of `labels` (h, w), for each bone."""
    shape = (labels.shape[0], labels.shape[1])
    seen = F.interpolate(segmentation[None], shape, mode="bilinear")[0].argmax(0)
    return np.array(
        [
            (2 * float(((seen == n) & (labels == n)).sum()), float((seen == n).sum() + (labels == n).sum()))
            for n in HIP.classes(HIP.bone_names)
        ]
    )


def _start(detection: Detection, image: LabelledImage) -> Tensor | None:
    """The start pose (4, 4); None if it is refused."""
    landmarks = dict(zip(HIP.landmark_names, image.points, strict=True))
    try:
        return find_start(
            landmarks, detection, image.attenuation, image.camera, image.outline, HIP, beam=image.display.beam
        ).camera_from_ct
    except InputError:
        return None


def _pose_error(pose: Tensor | None, image: LabelledImage) -> Array:
    """Degrees, mm across and mm in depth (3,) at the landmarks' middle; nan without a pose."""
    if pose is None:
        return np.full(3, np.nan)
    truth = image.camera_from_lps.double()
    turned = torch.rad2deg(rotation_angle(pose[:3, :3] @ truth[:3, :3].mT)).item()
    middle = image.points.double().mean(0, keepdim=True)
    shift = (transform_points(pose, middle) - transform_points(truth, middle))[0]
    return np.array([turned, shift[:2].norm().item(), shift[2].abs().item()])
