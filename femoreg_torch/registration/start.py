"""The start pose: landmarks in view 1, PnP (paper, section II-A), and then the outlines of the hip bones."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, transform_points
from femoreg_torch.pnp import MINIMUM, PnpResult, solve_pnp
from femoreg_torch.registration.scene import Scene, Segmentation
from femoreg_torch.registration.silhouette import refine_by_silhouette
from femoreg_torch.volume import HIP_LANDMARKS, LANDMARK_SPREAD_MM, Volume

Detector = Callable[[Tensor, Camera], Detection]  # finds the landmarks in an attenuation image (H, W) of a camera


# Chosen on procedural patients 101 and 102, also where shutters leave less than half of the image.
LEAST_OVERLAP = 0.90  # Dice of the hip bones
# Greatest standard deviation of the rotation, over all axes, of a start by landmarks alone. Outlines mend what is more
# open (9° open: 2 to 3° off afterwards).
MOST_ROTATION_DEG = 5.0


@dataclass(frozen=True)
class Start:
    """A start pose and what speaks for it."""

    camera_from_ct: Tensor  # (4, 4) float64
    pnp: PnpResult
    used: list[int]  # numbers of the landmarks that PnP was given
    overlap: float | None  # of the hip bones drawn and seen; None where the CT does not tell them apart


def start_from_landmarks(case: Case, scene: Scene, detection: Detection) -> tuple[Tensor, dict[str, Any]]:
    """`camera1_from_pelvis` (4, 4) from what is seen in view 1, and what to keep of how it came.

    Raises `InputError` as `find_start` does, with the image's name.
    """
    image = scene.images["anatomy"][0]
    try:
        start = find_start(case.landmarks, detection, image, case.carm.camera, scene.hips)
    except InputError as error:
        raise InputError(f"{case.views[0].anatomy}: {error}") from error
    return start.camera_from_ct, _summary(detection, start)


def find_start(
    landmarks: Mapping[str, Tensor], detection: Detection, attenuation: Tensor, camera: Camera, hips: Volume | None
) -> Start:
    """The pose of a CT with `landmarks` (3,) in an image (H, W), by PnP and then by the outlines of its `hips`.

    Raises `InputError` if the grey values are inverted, which would mislead the similarity even where the landmarks are
    found, if fewer than four landmarks are of use or agree, if the hip bones drawn at the pose cover those that the
    network sees by less than 90 % (Dice), or, without hip bones, if the landmarks leave the rotation open by more than
    5°.
    """
    if detection.inverted:
        raise InputError(
            "bone seems to be darker than soft tissue where it should be brighter. Set `intensity` of the view (raw: "
            "bone dark, log: bone bright), or invert the picture."
        )
    usable = [i for i, name in enumerate(HIP_LANDMARKS) if name in landmarks and bool(detection.visible[i])]
    if len(usable) < MINIMUM:
        raise InputError(
            f"{len(usable)} usable landmarks found, at least {MINIMUM} are needed. Is this a hip, and is `intensity` "
            "of the view right (raw: bone dark, log: bone bright)?"
        )
    points = torch.stack([landmarks[HIP_LANDMARKS[i]] for i in usable]).double()
    spread = torch.tensor(LANDMARK_SPREAD_MM, dtype=torch.float64)[usable]
    seen = (detection.pixels[usable], camera, detection.confidence[usable], detection.deviation_px[usable])
    pnp = solve_pnp(points, *seen, spread)
    if hips is None:
        _check_rotation(pnp)
        return Start(pnp.camera_from_object, pnp, usable, None)
    centre = transform_points(pnp.camera_from_object, points).mean(0)
    bones = Segmentation(detection.segmentation, detection.network_camera)
    fit = refine_by_silhouette(hips, pnp.camera_from_object, centre, pnp.covariance, bones, attenuation, camera)
    if fit.overlap < LEAST_OVERLAP:
        raise InputError(
            f"the hip bones of the CT, drawn where the landmarks put them, and those that the network sees agree by "
            f"{fit.overlap:.0%} only (Dice; {LEAST_OVERLAP:.0%} are asked for). Is it the same patient? Otherwise take "
            "a view that shows more of the pelvis."
        )
    return Start(fit.camera_from_ct, pnp, usable, fit.overlap)


def _check_rotation(pnp: PnpResult) -> None:
    if pnp.rotation_deviation_deg > MOST_ROTATION_DEG:
        raise InputError(
            f"too few usable landmarks: {int(pnp.inliers.sum())} of {len(pnp.inliers)} agree, but they fix the "
            f"rotation only to {pnp.rotation_deviation_deg:.0f}°, and no outlines help, as the CT's labels do not tell "
            "the hip bones apart. Take a view that shows more of the pelvis, or label the hip bones 1 (left) and 2 "
            "(right)."
        )


def with_segmentations(scene: Scene, first: Detection, find: Detector) -> Scene:
    """The scene with what the network sees of the bones in every view; `first` is what it saw in view 1."""
    others = [find(image, scene.carm.camera) for image in scene.images["anatomy"][1:]]
    seen = tuple(Segmentation(found.segmentation, found.network_camera) for found in (first, *others))
    return replace(scene, segmentations=seen)


def _summary(detection: Detection, start: Start) -> dict[str, Any]:
    inliers = {HIP_LANDMARKS[i] for i, inlier in zip(start.used, start.pnp.inliers.tolist(), strict=True) if inlier}
    return {
        "landmarks": {
            name: {
                "pixel": detection.pixels[i],
                "confidence": float(detection.confidence[i]),
                "visible": bool(detection.visible[i]),
                "used": name in inliers,
            }
            for i, name in enumerate(HIP_LANDMARKS)
        },
        "reprojection_rms_px": start.pnp.rms_px,
        "silhouette_overlap": start.overlap,
        "camera1_from_pelvis": start.camera_from_ct,
    }
