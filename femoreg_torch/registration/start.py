"""The start pose: landmarks that the network finds in view 1, and PnP (paper, section II-A)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera
from femoreg_torch.pnp import MINIMUM, PnpResult, solve_pnp
from femoreg_torch.registration.scene import Scene, Segmentation
from femoreg_torch.volume import HIP_LANDMARKS

Detector = Callable[[Tensor, Camera], Detection]  # finds the landmarks in an attenuation image (H, W) of a camera


def start_from_landmarks(case: Case, detection: Detection) -> tuple[Tensor, dict[str, Any]]:
    """`camera1_from_pelvis` (4, 4) from the landmarks that are seen in view 1, and what to keep of how it came.

    Raises `InputError` if fewer than four landmarks are of use, or if the grey values are inverted, which would mislead
    the similarity even where the landmarks are found.
    """
    if detection.inverted:
        raise InputError(
            f"{case.views[0].anatomy}: bone seems to be darker than soft tissue where it should be brighter. Set "
            "`intensity` of the view (raw: bone dark, log: bone bright), or invert the picture."
        )
    usable = [i for i, name in enumerate(HIP_LANDMARKS) if name in case.landmarks and bool(detection.visible[i])]
    if len(usable) < MINIMUM:
        raise InputError(
            f"{case.views[0].anatomy}: {len(usable)} usable landmarks found, at least {MINIMUM} are needed. Is this a "
            "hip, and is `intensity` of the view right (raw: bone dark, log: bone bright)?"
        )
    points = torch.stack([case.landmarks[HIP_LANDMARKS[i]] for i in usable])
    seen = (detection.pixels[usable], case.carm.camera, detection.confidence[usable], detection.deviation_px[usable])
    pose = solve_pnp(points, *seen)
    return pose.camera_from_object, _summary(detection, pose, usable)


def with_segmentations(scene: Scene, first: Detection, find: Detector) -> Scene:
    """The scene with what the network sees of the bones in every view; `first` is what it saw in view 1."""
    others = [find(image, scene.carm.camera) for image in scene.images["anatomy"][1:]]
    seen = tuple(Segmentation(found.segmentation, found.network_camera) for found in (first, *others))
    return replace(scene, segmentations=seen)


def _summary(detection: Detection, pose: PnpResult, usable: list[int]) -> dict[str, Any]:
    inliers = {HIP_LANDMARKS[i] for i, inlier in zip(usable, pose.inliers.tolist(), strict=True) if inlier}
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
        "reprojection_rms_px": pose.rms_px,
        "camera1_from_pelvis": pose.camera_from_object,
    }
