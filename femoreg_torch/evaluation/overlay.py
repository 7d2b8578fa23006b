"""Overlays: edges of the rendered objects, each in its own colour, on the fluoroscopy that they were registered to."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.drr import project
from femoreg_torch.evaluation.colours import GUIDE, PATH, Colour, object_colours
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera, Poses, project_points, transform_points
from femoreg_torch.pictures import put_words
from femoreg_torch.registration import Scene
from femoreg_torch.registration.scene import Kind

_WIDTH_PX = 512  # of one panel, or a little more: the detector is averaged over whole blocks
_LEAST_SHOWN = 0.02  # of the largest line integral: where an object is taken to be seen

_LANDMARK = (255, 255, 255)
_MOST_CONTRAST, _CONTRAST_TILES = 3.0, (6, 6)  # of adaptive histogram equalisation

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Drawn:
    """The fluoroscopy of a scene and renderings of its objects, on pixels averaged over whole blocks."""

    cameras: tuple[Camera, ...]  # of every view
    images: dict[tuple[Kind, int], Picture]  # (H, W, 3) grey, of every image there is, by kind and view (from 0)
    integrals: dict[tuple[str, int], Tensor]  # (H, W) line integrals of every object that images of a view show


@dataclass(frozen=True, eq=False)
class Line:
    """Something of the plan, or of the guide, as seen in an image: points (column, row) joined by a line."""

    name: str
    pixels: tuple[tuple[float, float], ...]


def draw(scene: Scene, poses: Poses, width_px: int = _WIDTH_PX) -> Drawn:
    """Draw a scene at `poses`, on images of `width_px` or a little more.

    The grey values are windowed by what lies within the shutters and, where it is seen there, behind the objects that
    all images show: neither the direct beam nor a shutter nor metal sets them.
    """
    factor = max(1, scene.carm.camera.shape[1] // width_px)
    cameras = tuple(poses.camera(view, scene.carm.camera.downsampled(factor)) for view in range(scene.views))
    integrals = {
        (name, view): project([scene.objects[name].volume], poses.camera_from(name)[view][None, None], camera)[0]
        for name in poses.camera1_from
        for view, camera in enumerate(cameras)
        if scene.there(scene.objects[name].shown_in, (view,))
    }
    images = {}
    for kind, view in scene.there(scene.images, range(scene.views)):
        bodies = [
            integrals[n, view] for n in scene.shown(poses.camera1_from, scene.first_kind) if (n, view) in integrals
        ]
        field = small_field(scene, kind, view, factor)
        seen = _seen(bodies, field)
        images[kind, view] = monitor_picture(downsample(scene.image(kind, view), factor), field, seen)
    return Drawn(cameras, images, integrals)


def _seen(bodies: list[Tensor], field: Tensor | None) -> Tensor | None:
    """Exposed pixels (H, W) behind any of these objects; None if there are hardly any."""
    if not bodies:
        return None
    total = torch.stack(bodies).sum(0)
    seen = total > _LEAST_SHOWN * total.max()
    if field is not None:
        seen &= field
    return seen if float(seen.double().mean()) > _LEAST_SHOWN else None


def overlay_figure(case: Case, scene: Scene, poses: Poses, drawn: Drawn | None = None) -> Picture:
    """A column per view (H, W, 3), a row per kind of images, with edges of the objects that this kind shows first.

    A panel without an image is black. Landmarks of the CT are drawn on the first row, planned path and guide on all.
    What `draw` gives at these poses is used if it is there already.
    """
    drawn = drawn or draw(scene, poses)
    colours = object_colours(scene.objects)
    rows = []
    for kind, names in new_objects(scene).items():
        panels = []
        for view, camera in enumerate(drawn.cameras):
            if (kind, view) not in drawn.images:
                panels.append(np.zeros((*camera.shape, 3), np.uint8))
                continue
            panel = drawn.images[kind, view].copy()
            for name in names:
                if (name, view) in drawn.integrals:
                    paint_edges(panel, drawn.integrals[name, view], colours[name])
            if kind == scene.first_kind:
                _draw_landmarks(panel, case, scene, poses, view, camera)
            for line in plan_lines(case, poses, view, camera, kind, scene):
                ends = np.array(line.pixels).round().astype(np.int32)
                cv2.polylines(panel, [ends], False, _bgr(PATH if line.name == "path" else GUIDE), 1, cv2.LINE_AA)
            panels.append(panel)
        rows.append(np.hstack(panels))
    return np.vstack(rows)


class Renderer:
    """DRRs of the objects in the views, the last one of each kept: from frame to frame most stand still."""

    def __init__(self, scene: Scene, camera: Camera, step_mm: float = 1.0) -> None:
        self._scene, self._camera, self._step_mm = scene, camera, step_mm
        self.colours = object_colours(scene.objects)
        self._last: dict[tuple[str, int], tuple[Camera, Tensor, Tensor]] = {}

    def __call__(self, poses: Poses, name: str, view: int) -> Tensor:
        """Line integrals (H, W) of one object in one view."""
        camera_from_object = poses.camera_from(name)[view]
        camera = poses.camera(view, self._camera)
        last = self._last.get((name, view))
        if last is not None and last[0] == camera and torch.equal(last[1], camera_from_object):
            return last[2]
        volume = self._scene.objects[name].volume
        drawn = project(volume, camera_from_object[None], camera, self._step_mm)[0]
        self._last[name, view] = (camera, camera_from_object, drawn)
        return drawn


def new_objects(scene: Scene) -> dict[str, list[str]]:
    """For every kind of images, the objects that no kind before it shows."""
    shown: set[str] = set()
    new: dict[str, list[str]] = {}
    for kind in scene.images:
        new[kind] = [name for name in scene.shown(scene.objects, kind) if name not in shown]
        shown |= set(new[kind])
    return new


def paint_edges(picture: Picture, drawn: Tensor, colour: Colour) -> None:
    """Draw the edges of line integrals (H, W) into a picture (H, W, 3) of the same camera."""
    picture[edges_of(drawn)] = _bgr(colour)


def _bgr(colour: Colour) -> tuple[int, int, int]:
    """As OpenCV takes it."""
    red, green, blue = colour
    return blue, green, red


def edges_of(drawn: Tensor) -> NDArray[np.bool_]:
    """Pixels (H, W) on an edge of a DRR (H, W); none where the structure lies outside the view."""
    image = drawn.numpy()
    if not image.any():
        return np.zeros(image.shape, bool)
    bright = np.percentile(image[image > 0], 98)
    grey = cv2.GaussianBlur((image / bright * 255).clip(0, 255).astype(np.uint8), (0, 0), 1.2)
    return cv2.Canny(grey, 30, 70) > 0


def landmark_pixels(
    case: Case, scene: Scene, poses: Poses, view: int, camera: Camera
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Landmarks of the CT, which lie on the anchor and beside it, that a view (from 0) shows, as column and row."""
    for name, point in case.landmarks.items():
        pixel = project_points(camera, transform_points(poses.camera_from(scene.anchor)[view], point[None]))[0]
        column, row = pixel.tolist()
        if 0 <= column < camera.shape[1] and 0 <= row < camera.shape[0]:
            yield name, (column, row)


def plan_lines(case: Case, poses: Poses, view: int, camera: Camera, kind: Kind, scene: Scene) -> Iterator[Line]:
    """`path`, from the entry point to the target, and, in images that show the tool, `guide`, from base to tip.

    What a view (from 0) does not have in front of its source, or has no pose, is left out.
    """
    plan = case.plan
    if plan is None:
        return
    found = [("path", plan.object, (plan.entry_point, plan.target))]
    if plan.tool is not None and kind in scene.objects[plan.tool].shown_in:
        points = case.objects[plan.tool].points
        found.append(("guide", plan.tool, (points["base"], points["tip"])))
    for name, thing, ends in found:
        if thing not in poses.camera1_from:
            continue
        pixels = project_points(camera, transform_points(poses.camera_from(thing)[view], torch.stack(ends)))
        if pixels.isfinite().all():
            (x0, y0), (x1, y1) = pixels.tolist()
            yield Line(name, ((x0, y0), (x1, y1)))


def _draw_landmarks(picture: Picture, case: Case, scene: Scene, poses: Poses, view: int, camera: Camera) -> None:
    for name, (column, row) in landmark_pixels(case, scene, poses, view, camera):
        place = (round(column), round(row))
        cv2.drawMarker(picture, place, _LANDMARK, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
        beside = (place[0] + 5, place[1] - 4)
        put_words(picture, name, beside, 0.4, _LANDMARK)


def small_field(scene: Scene, kind: Kind, view: int, factor: int) -> Tensor | None:
    """The exposed pixels of an image averaged by a whole factor; None where all are."""
    field = scene.field(kind, view)
    return None if field is None else downsample(field, factor) > 0.5


def monitor_picture(attenuation: Tensor, field: Tensor | None = None, seen: Tensor | None = None) -> Picture:
    """An attenuation image (H, W) as a monitor shows it (bone dark), grey (H, W, 3), its local contrast equalised.

    What sets its window: the pixels `seen` (H, W), bool; else the body within the exposed `field` (H, W), bool; by
    default within the whole image. Pixels outside the field are black.
    """
    values = attenuation.numpy()
    if seen is not None:
        body = values[seen.numpy()]
    else:
        exposed = values if field is None else values[field.numpy()]
        body = exposed[exposed > 0.15 * exposed.max()]  # the direct beam must not set the window
        body = body if body.size else exposed  # nothing but direct beam
    low, high = np.percentile(body, [1, 99.8])
    shown = ((high - values) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8)
    # so that bone is seen behind thick and thin soft tissue alike
    shown = cv2.createCLAHE(_MOST_CONTRAST, _CONTRAST_TILES).apply(shown)
    if field is not None:
        shown[~field.numpy()] = 0
    return np.repeat(shown[..., None], 3, axis=2)
