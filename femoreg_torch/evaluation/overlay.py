"""Overlays: edges of the rendered objects, in green, on the fluoroscopy that they were registered to."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.drr import project
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera, Poses, project_points, transform_points
from femoreg_torch.registration import Scene
from femoreg_torch.registration.scene import Kind
from femoreg_torch.volume import Volume

GREEN, RED, _MAGENTA = (0, 255, 0), (60, 60, 255), (255, 60, 255)  # blue, green, red
_WIDTH_PX = 512  # of one panel, or a little more: the detector is averaged over whole blocks

Picture = NDArray[np.uint8]


def overlay_figure(case: Case, scene: Scene, poses: Poses) -> Picture:
    """A column per view (H, W, 3), a row per kind of images, with edges of the objects that this kind shows first.

    A panel without an image is black. Landmarks of the CT and the planned path are drawn on the first row.
    """
    factor = max(1, scene.carm.camera.shape[1] // _WIDTH_PX)
    cameras = [poses.camera(view, scene.carm.camera.downsampled(factor)) for view in range(scene.views)]
    rows = []
    for kind, names in new_objects(scene).items():
        panels = []
        for view, image in enumerate(scene.images[kind]):
            if image is None:
                panels.append(np.zeros((*cameras[view].shape, 3), np.uint8))
                continue
            panel = monitor_picture(downsample(image, factor), small_field(scene, kind, view, factor))
            placed = [name for name in names if name in poses.camera1_from]
            draw_edges(panel, [(scene.objects[n].volume, poses.camera_from(n)[view]) for n in placed], cameras[view])
            if kind == scene.first_kind:
                _draw_plan(panel, case, scene.anchor, poses, view, cameras[view])
            panels.append(panel)
        rows.append(np.hstack(panels))
    return np.vstack(rows)


def new_objects(scene: Scene) -> dict[str, list[str]]:
    """For every kind of images, the objects that no kind before it shows."""
    shown: set[str] = set()
    new: dict[str, list[str]] = {}
    for kind in scene.images:
        new[kind] = [name for name in scene.shown(scene.objects, kind) if name not in shown]
        shown |= set(new[kind])
    return new


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


def _draw_plan(picture: Picture, case: Case, anchor: str, poses: Poses, view: int, camera: Camera) -> None:
    """Landmarks of the CT, which lie on the `anchor` and beside it, and the planned path."""
    for name, point in case.landmarks.items():
        column, row = project_points(camera, transform_points(poses.camera_from(anchor)[view], point[None]))[0].tolist()
        if 0 <= column < camera.shape[1] and 0 <= row < camera.shape[0]:
            place = (round(column), round(row))
            cv2.drawMarker(picture, place, RED, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
            beside = (place[0] + 5, place[1] - 4)
            cv2.putText(picture, name, beside, cv2.FONT_HERSHEY_SIMPLEX, 0.35, RED, 1, cv2.LINE_AA)
    if case.plan is not None and case.plan.object in poses.camera1_from:
        ends = torch.stack([case.plan.entry_point, case.plan.target])
        path = transform_points(poses.camera_from(case.plan.object)[view], ends)
        start, end = project_points(camera, path).round().int().tolist()
        cv2.line(picture, start, end, _MAGENTA, 1, cv2.LINE_AA)


def small_field(scene: Scene, kind: Kind, view: int, factor: int) -> Tensor | None:
    """The exposed pixels of an image averaged by a whole factor; None where all are."""
    field = scene.field(kind, view)
    return None if field is None else downsample(field, factor) > 0.5


def monitor_picture(attenuation: Tensor, field: Tensor | None = None) -> Picture:
    """An attenuation image (H, W) as a monitor shows it (bone dark), grey (H, W, 3).

    The exposed `field` (H, W), bool, sets its window; by default the whole image.
    """
    values = attenuation.numpy()
    exposed = values if field is None else values[field.numpy()]
    body = exposed[exposed > 0.15 * exposed.max()]  # the direct beam must not set the window
    low, high = np.percentile(body, [1, 99.8])
    shown = ((high - values) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2)
