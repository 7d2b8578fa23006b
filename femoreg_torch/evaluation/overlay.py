"""Overlays: edges of the rendered structures, in green, on the fluoroscopy that they were registered to."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.case import Case, Truth
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import check_matches, downsample, read_image
from femoreg_torch.geometry import Camera, invert_rigid, project_points, transform_points
from femoreg_torch.registration.prepare import device_attenuation
from femoreg_torch.volume import (
    Volume,
    read_ct,
    read_labels,
    resample_isotropic,
    structure_attenuation,
)

GREEN, RED, _MAGENTA = (0, 255, 0), (60, 60, 255), (255, 60, 255)  # blue, green, red
_WIDTH_PX = 512  # of one panel, or a little more: the detector is averaged over whole blocks
_SPACING_MM = 1.0

Picture = NDArray[np.uint8]


def overlay_figure(case: Case, poses: Truth) -> Picture:
    """A column per view (H, W, 3): anatomy with pelvis, femur and landmarks above, device below, at these poses."""
    camera = case.carm.camera.downsampled(max(1, case.carm.camera.shape[1] // _WIDTH_PX))
    pelvis, femur, device = _structures(case)
    columns = []
    for number, view in enumerate(case.views):
        camera_from_pelvis = poses.camera_from_pelvis[number]
        camera_from_camera1 = camera_from_pelvis @ invert_rigid(poses.camera_from_pelvis[0])
        camera_from_femur = camera_from_camera1 @ poses.camera1_from_femur
        panels = [monitor_picture(view.anatomy, view.intensity, case, camera)]
        draw_edges(panels[0], [(pelvis, camera_from_pelvis), (femur, camera_from_femur)], camera)
        _draw_landmarks(panels[0], case, camera_from_pelvis, camera_from_femur, camera)
        if view.device is not None and device is not None and poses.camera1_from_device is not None:
            panels.append(monitor_picture(view.device, view.intensity, case, camera))
            draw_edges(panels[1], [(device, camera_from_camera1 @ poses.camera1_from_device)], camera)
        columns.append(panels)
    height = max(len(panels) for panels in columns)
    empty = np.zeros_like(columns[0][0])
    rows = [np.hstack([p[row] if row < len(p) else empty for p in columns]) for row in range(height)]
    return np.vstack(rows)


def _structures(case: Case) -> tuple[Volume, Volume, Volume | None]:
    if case.labels_path is None:
        raise InputError(
            f"{case.folder}: has no label map, so no structure can be drawn. Add `ct.labels` to case.yaml."
        )
    ct = read_ct(case.ct_path)
    labels = resample_isotropic(read_labels(case.labels_path, ct), _SPACING_MM, nearest=True)
    ct = resample_isotropic(ct, _SPACING_MM)
    pelvis, femur = (structure_attenuation(ct, labels, case.structures[name]) for name in ("pelvis", case.femur))
    if case.device is None:
        return pelvis, femur, None
    return pelvis, femur, device_attenuation(case.device)


def draw_edges(picture: Picture, posed: Sequence[tuple[Volume, Tensor]], camera: Camera) -> None:
    """Draw the DRR edges of volumes, each with its `camera_from_volume` (4, 4), into a picture of `camera`."""
    for volume, camera_from_volume in posed:
        picture[edges_of(project([volume], camera_from_volume[None, None], camera)[0])] = GREEN


def edges_of(drawn: Tensor) -> NDArray[np.bool_]:
    """Pixels (H, W) on an edge of a DRR (H, W); none where the structure lies outside the view."""
    image = drawn.numpy()
    if not image.any():
        return np.zeros(image.shape, bool)
    bright = np.percentile(image[image > 0], 98)
    grey = cv2.GaussianBlur((image / bright * 255).clip(0, 255).astype(np.uint8), (0, 0), 1.2)
    return cv2.Canny(grey, 30, 70) > 0


def _draw_landmarks(
    picture: Picture, case: Case, camera_from_pelvis: Tensor, camera_from_femur: Tensor, camera: Camera
) -> None:
    for name, point in case.landmarks.items():
        column, row = project_points(camera, transform_points(camera_from_pelvis, point[None]))[0].tolist()
        if 0 <= column < camera.shape[1] and 0 <= row < camera.shape[0]:
            place = (round(column), round(row))
            cv2.drawMarker(picture, place, RED, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
            beside = (place[0] + 5, place[1] - 4)
            cv2.putText(picture, name, beside, cv2.FONT_HERSHEY_SIMPLEX, 0.35, RED, 1, cv2.LINE_AA)
    path = transform_points(camera_from_femur, torch.stack([case.entry_point, case.target]))
    start, end = project_points(camera, path).round().int().tolist()
    cv2.line(picture, start, end, _MAGENTA, 1, cv2.LINE_AA)


def monitor_picture(path: Path, intensity: str, case: Case, camera: Camera) -> Picture:
    """An image as a monitor shows it (bone dark), grey (H, W, 3) on the grid of `camera`."""
    image = read_image(path)
    check_matches(image, case.carm.camera, str(path))
    small = downsample(image, case.carm.camera.shape[1] // camera.shape[1]).numpy()
    attenuation = small if intensity == "log" else -np.log(small.clip(1) / small.max())
    body = attenuation[attenuation > 0.15 * attenuation.max()]  # the direct beam must not set the window
    low, high = np.percentile(body, [1, 99.8])
    shown = ((high - attenuation) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2)
