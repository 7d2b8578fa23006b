"""A picture of what was detected."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.detect.network import Detection
from femoreg_torch.geometry import Camera

_WIDTH = 768  # pixels of the picture


def class_colours(anatomy: Anatomy) -> NDArray[np.float32]:
    """RGB (C, 3) of the classes of a segmentation: black for the background, then the bones."""
    return np.array([(0, 0, 0), *(bone.colour for bone in anatomy.bones)], dtype=np.float32)


def draw_overlay(attenuation: Tensor, detection: Detection, camera: Camera) -> NDArray[np.uint8]:
    """RGB picture (h, 768, 3): image (H, W) in grey, bones tinted, visible landmarks named in their bones' colours."""
    zoom = _WIDTH / attenuation.shape[1]
    size = (_WIDTH, round(attenuation.shape[0] * zoom))
    low, high = (torch.quantile(attenuation.flatten()[::7].float(), q).item() for q in (0.005, 0.995))
    grey = ((attenuation.float() - low) / max(high - low, 1e-12)).clamp(0, 1).numpy() * 255
    picture = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)[..., None].repeat(3, 2)
    labels = _labels_on_picture(detection, camera, zoom, size)
    tint = np.where(labels[..., None] > 0, 0.25, 0.0)
    picture = ((1 - tint) * picture + tint * class_colours(detection.anatomy)[labels]).astype(np.uint8)
    for landmark, pixel, visible in zip(detection.anatomy.landmarks, detection.pixels, detection.visible, strict=True):
        if visible:
            column, row = (round(v) for v in ((pixel + 0.5) * zoom - 0.5).tolist())
            colour = detection.anatomy.bone(landmark.bone).colour
            cv2.circle(picture, (column, row), 4, colour, 1, cv2.LINE_AA)
            place = (column + 6, row - 4)
            cv2.putText(picture, landmark.name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def _labels_on_picture(detection: Detection, camera: Camera, zoom: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The most probable class of each pixel (h, w) of the picture, 0 outside of the network's grid."""
    grid = detection.network_camera
    # Both images lie on one detector: mm from the principal point, column and row, agree.
    affine = np.zeros((2, 3))
    for axis, (pixel_mm, grid_mm) in enumerate(zip(reversed(camera.pixel_mm), reversed(grid.pixel_mm), strict=True)):
        ratio = pixel_mm / grid_mm
        affine[axis, axis] = ratio / zoom
        start = 0.5 / zoom - 0.5 - camera.principal_point_px[axis]
        affine[axis, 2] = grid.principal_point_px[axis] + ratio * start
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    probabilities = [cv2.warpAffine(p, affine, size, flags=flags) for p in detection.segmentation.float().numpy()]
    return np.argmax(probabilities, 0).astype(np.uint8)
