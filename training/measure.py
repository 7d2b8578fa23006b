"""How well a network reads images of patients it has not seen: landmarks, bones, and the start pose that comes of them.

An image is read as `femoreg detect` reads it. A landmark counts as found if it is visible to `detect`. Errors are over
those in the image that were found; misses and false finds are counted beside them. Confidence intervals are by
bootstrap over patients, because images of one patient are no independent evidence.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from femoreg_torch.detect import Detection, detect, network_camera
from femoreg_torch.detect.looks import LOOKS, Look
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import attenuation_image
from femoreg_torch.geometry import Camera, rotation_angle, transform_points
from femoreg_torch.registration.start import find_start
from femoreg_torch.volume import HIP_LANDMARKS, Volume
from sim.labelled_images import read_labelled
from training.augmentation import Batch, inside

Array = NDArray[np.float64]

GROSS_MM = 20.0
FAIR = (5.0, 10.0, 50.0)  # degrees, mm across, mm in depth
COARSE = (10.0, 20.0, 100.0)
REGISTERED_DEG = 1.0
_LEAST_VISIBLE = 6  # landmarks in an image that a pose is asked of
_LABELS = range(1, 7)
_REDRAWS = 2000


@dataclass(frozen=True)
class LabelledImage:
    """An image and the truth about it."""

    patient: str
    attenuation: Tensor  # (H, W)
    camera: Camera
    landmarks: Tensor  # (14, 2) column, row, also outside of the image
    labels: Tensor  # (h, w) uint8 on the network's grid or, half as fine, that of its output
    visible: Tensor  # (14,) bool
    points: Tensor | None = None  # (14, 3) LPS mm
    camera_from_lps: Tensor | None = None  # (4, 4) rigid
    hips: Volume | None = None  # 1 inside the hip bones, LPS mm


@dataclass(frozen=True)
class Reading:
    """What became of one image."""

    patient: str
    error_mm: Array  # (14,) on the detector
    found: NDArray[np.bool_]  # (14,)
    visible: NDArray[np.bool_]  # (14,)
    confidence: Array  # (14,)
    overlap: Array  # (6, 2): 2 |A ∩ B| and |A| + |B| in pixels, labels 1 to 6
    asked: bool  # whether a pose was asked for
    refused: bool  # no pose was given
    pose_error: Array  # (3,) degrees, mm across, mm in depth at the landmarks' middle; nan without a pose
    registered_error: Array | None = None  # (3,) the same after single-view registration, if it was run


@dataclass(frozen=True)
class Measure:
    """A figure and its 95 % confidence interval by bootstrap over patients."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Accuracy:
    """Figures of a set of readings; nan where nothing could be counted."""

    images: int
    patients: int
    measures: dict[str, Measure]
    landmarks: dict[int, tuple[float, float, float, int]] = field(
        default_factory=dict
    )  # mean, median, recall, in image


def images_of_batches(batches: Iterable[Batch], camera: Camera, patient: str) -> Iterable[LabelledImage]:
    """The images of training batches, which are on the network's grid for images of `camera`."""
    grid = network_camera(camera)
    for batch in batches:
        for n in range(len(batch.images)):
            pixels = batch.landmarks[n] * 2 + 0.5
            yield LabelledImage(patient, batch.images[n, 0], grid, pixels, batch.labels[n], batch.visible[n])


def images_of_file(path: Path) -> Iterable[LabelledImage]:
    """The images of a file of `sim.labelled_images`."""
    content = read_labelled(path)
    points = content.landmarks_lps
    hips = Volume(content.hips.float() / 255, content.lps_from_hips)
    for n in range(len(content.images)):
        attenuation, pixels = attenuation_image(content.images[n].float()), content.landmarks[n]
        visible = inside(pixels, content.camera.shape)
        yield LabelledImage(
            content.source,
            attenuation,
            content.camera,
            pixels,
            content.labels[n],
            visible,
            points,
            content.camera_from_lps[n],
            hips,
        )


def read_images(
    network: nn.Module,
    images: Iterable[LabelledImage],
    looks: tuple[Look, ...] = LOOKS,
    register: Callable[[LabelledImage, Tensor], Tensor] | None = None,
) -> list[Reading]:
    """Detect and, where there is a patient's geometry, find the start pose of each image, and then `register` it."""
    return [_read(detect(network, image.attenuation, image.camera, looks), image, register) for image in images]


def _read(
    detection: Detection, image: LabelledImage, register: Callable[[LabelledImage, Tensor], Tensor] | None
) -> Reading:
    pixel_mm = torch.tensor(image.camera.pixel_mm[::-1], dtype=torch.float64)
    error = ((detection.pixels - image.landmarks) * pixel_mm).norm(dim=1)
    there = image.visible & inside(image.landmarks, image.camera.shape)
    shape = (image.labels.shape[0], image.labels.shape[1])
    seen = F.interpolate(detection.segmentation[None], shape, mode="bilinear")[0].argmax(0)
    overlap = [
        (2 * float(((seen == n) & (image.labels == n)).sum()), float((seen == n).sum() + (image.labels == n).sum()))
        for n in _LABELS
    ]
    asked = image.points is not None and image.camera_from_lps is not None and int(there.sum()) >= _LEAST_VISIBLE
    start = _start(detection, image) if asked else None
    registered = register(image, start) if register is not None and start is not None else None
    return Reading(
        image.patient,
        error.numpy(),
        detection.visible.numpy(),
        there.numpy(),
        detection.confidence.numpy(),
        np.array(overlap),
        asked,
        asked and start is None,
        _pose_error(start, image),
        None if register is None else _pose_error(registered, image),
    )


def _start(detection: Detection, image: LabelledImage) -> Tensor | None:
    """The start pose (4, 4); None if it is refused."""
    assert image.points is not None
    landmarks = dict(zip(HIP_LANDMARKS, image.points, strict=True))
    try:
        return find_start(landmarks, detection, image.attenuation, image.camera, image.hips).camera_from_ct
    except InputError:
        return None


def _pose_error(pose: Tensor | None, image: LabelledImage) -> Array:
    """Degrees, mm across and mm in depth (3,) at the landmarks' middle; nan without a pose."""
    if pose is None:
        return np.full(3, np.nan)
    assert image.points is not None
    assert image.camera_from_lps is not None
    truth = image.camera_from_lps.double()
    turned = torch.rad2deg(rotation_angle(pose[:3, :3] @ truth[:3, :3].mT)).item()
    middle = image.points.double().mean(0, keepdim=True)
    shift = (transform_points(pose, middle) - transform_points(truth, middle))[0]
    return np.array([turned, shift[:2].norm().item(), shift[2].abs().item()])


def summarise(readings: Sequence[Reading], seed: int = 0) -> Accuracy:
    """All figures with their intervals, and per landmark mean, median, recall and how often it is in the image."""
    patients = sorted({reading.patient for reading in readings})
    groups = [[reading for reading in readings if reading.patient == patient] for patient in patients]
    value = _figures(readings)
    rng = np.random.default_rng(seed)
    redraws = Counter(tuple(sorted(rng.integers(len(groups), size=len(groups)))) for _ in range(_REDRAWS))
    drawn: dict[str, list[float]] = {name: [] for name in value}
    for redraw, times in redraws.items():
        for name, figure in _figures([reading for n in redraw for reading in groups[n]]).items():
            drawn[name] += [figure] * times
    measures = {
        name: Measure(figure, *(float(v) for v in np.nanquantile(drawn[name], (0.025, 0.975))))
        if np.isfinite(drawn[name]).any()
        else Measure(figure, np.nan, np.nan)
        for name, figure in value.items()
    }
    return Accuracy(len(readings), len(patients), measures, _per_landmark(readings))


def _figures(readings: Sequence[Reading]) -> dict[str, float]:
    error, found, visible = (
        np.stack([getattr(r, name) for r in readings]) for name in ("error_mm", "found", "visible")
    )
    hits = error[found & visible]
    overlap, total = np.stack([r.overlap for r in readings]).sum(0).T
    dice = overlap / np.where(total > 0, total, np.nan)
    poses = np.array([r.pose_error for r in readings if r.asked]).reshape(-1, 3)
    refused = np.array([r.refused for r in readings if r.asked])
    figures = {
        "mean_mm": _of(np.mean, hits),
        "median_mm": _of(np.median, hits),
        "p90_mm": _of(lambda v: np.quantile(v, 0.9), hits),
        "gross": _of(np.mean, hits > GROSS_MM),
        "recall": _of(np.mean, found[visible]),
        "false_positives": _of(np.mean, found[~visible]),
        "within_10mm_or_missed": _of(np.mean, (found & (error < 10))[visible]),
    }
    figures |= {f"dice_{label}": float(dice[label - 1]) for label in _LABELS}
    figures["dice_mean"] = float(dice.mean())
    figures["pose_fair"] = _of(np.mean, np.all(poses < np.array(FAIR), axis=1))
    figures["pose_coarse"] = _of(np.mean, np.all(poses < np.array(COARSE), axis=1))
    figures["pose_refused"] = _of(np.mean, refused)
    registered = np.array([r.registered_error for r in readings if r.asked and r.registered_error is not None])
    figures["registered_1deg"] = _of(np.mean, registered.reshape(-1, 3)[:, 0] < REGISTERED_DEG)
    figures["rotation_median_deg"] = _of(np.nanmedian, poses[:, 0])
    return figures


def _of(statistic: Callable[[NDArray[Any]], Any], values: NDArray[Any]) -> float:
    return float(statistic(values)) if values.size else float("nan")


def _per_landmark(readings: Sequence[Reading]) -> dict[int, tuple[float, float, float, int]]:
    error, found, visible = (
        np.stack([getattr(r, name) for r in readings]) for name in ("error_mm", "found", "visible")
    )
    table = {}
    for n in range(error.shape[1]):
        hits = error[:, n][found[:, n] & visible[:, n]]
        table[n] = (
            _of(np.mean, hits),
            _of(np.median, hits),
            _of(np.mean, found[:, n][visible[:, n]]),
            int(visible[:, n].sum()),
        )
    return table
