"""Starts as a result keeps them."""

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, LandmarkRecord, StartRecord
from femoreg_torch.detect import Detection
from femoreg_torch.registration.prepare.images import view_distortion
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.start.find import Start

_NETWORK, _OUTLINES = "landmarks of the network", ", outlines"  # words of where a start comes from


def record_from_view_1(case: Case, scene: Scene, detection: Detection, start: Start) -> StartRecord:
    """A start in view 1 with the landmarks of `detection`, in pixels of the image as it is stored."""
    stored = case.display_of(0).pixels_to_stored(detection.pixels, case.carm.camera)
    if (distortion := view_distortion(case, 0)) is not None:
        stored = torch.from_numpy(distortion.bent(stored.numpy()))
    inliers = {name for name, inlier in zip(start.used, start.pnp.inliers.tolist(), strict=True) if inlier}
    marks = {
        name: LandmarkRecord(
            pair(stored[i]), float(detection.confidence[i]), bool(detection.visible[i]), name in inliers
        )
        for i, name in enumerate((case.anatomy or HIP).landmark_names)
    }
    source = ("few " if start.few else "") + _NETWORK + (_OUTLINES if start.overlap is not None else "")
    return StartRecord(scene.anchor, start.camera_from_ct, source, marks, start.pnp.rms_px, start.overlap)


def record_from_view(view: int, anchor: str, camera1_from: Tensor, start: Start) -> StartRecord:
    """A start in camera 1 that was found from another view (from 0); its landmarks, in that image, are left out."""
    source = f"{_NETWORK} in view {view + 1}{_OUTLINES if start.overlap is not None else ''}, and from there view 1"
    return StartRecord(anchor, camera1_from, source, {}, start.pnp.rms_px, start.overlap)


def pair(pixel: Tensor) -> tuple[float, float]:
    """Column and row of a pixel (2,), as numbers."""
    column, row = pixel.tolist()
    return column, row
