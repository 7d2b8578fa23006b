"""Pictures within a page, and the panels of a report: one for every fluoroscopic image."""

import base64
import io
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from PIL import Image
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.evaluation.colours import Colour, hexadecimal, object_colours
from femoreg_torch.evaluation.overlay import Drawn, Line, Picture, edges_of, landmark_pixels, plan_lines
from femoreg_torch.geometry import Camera, Poses, transform_points
from femoreg_torch.registration import Scene

PANEL_PX = 768  # width of a panel's image, or a little more
_JPEG_QUALITY = 82
_BAR_MM = 50.0  # of the scale


@dataclass(frozen=True, eq=False)
class Layer:
    """The edges of one object, as a transparent picture."""

    name: str
    colour: str
    source: str  # a data address


@dataclass(frozen=True, eq=False)
class Panel:
    """One fluoroscopic image, what is drawn over it, and what the objects look like there. Places are pixels."""

    title: str
    width: int
    height: int
    xray: str | None  # a data address; None where the view has no such image
    drr: str | None = None
    layers: tuple[Layer, ...] = ()
    lines: tuple[Line, ...] = ()
    landmarks: tuple[tuple[str, tuple[float, float]], ...] = ()
    scale_px: float | None = None  # of the bar
    scale_text: str = ""


def panels(case: Case, scene: Scene, poses: Poses, drawn: Drawn) -> list[Panel]:
    """A panel for each kind of images and each view, the views of a kind one after the other."""
    colours = object_colours(scene.objects)
    found = []
    for kind in scene.images:
        for view, camera in enumerate(drawn.cameras):
            rows, columns = camera.shape
            title = f"View {view + 1}, {kind}" if len(scene.images) > 1 else f"View {view + 1}"
            if (kind, view) not in drawn.images:
                found.append(Panel(title, columns, rows, None))
                continue
            shown = [name for name in scene.shown(poses.camera1_from, kind) if (name, view) in drawn.integrals]
            marks = landmark_pixels(case, scene, poses, view, camera) if kind == scene.first_kind else ()
            layers = [
                Layer(name, hexadecimal(colours[name]), edge_uri(drawn.integrals[name, view], colours[name]))
                for name in shown
            ]
            scale_px, scale_text = _scale(scene, case, poses, view, camera)
            found.append(
                Panel(
                    title,
                    columns,
                    rows,
                    jpeg_uri(drawn.images[kind, view]),
                    _drr_uri([drawn.integrals[name, view] for name in shown]) if shown else None,
                    tuple(layers),
                    tuple(plan_lines(case, poses, view, camera, kind, scene)),
                    tuple(marks),
                    scale_px,
                    scale_text,
                )
            )
    return found


def _scale(scene: Scene, case: Case, poses: Poses, view: int, camera: Camera) -> tuple[float | None, str]:
    """How long a bar of `_BAR_MM` looks at the depth of the planned object, or else of the anchor."""
    name = case.plan.object if case.plan is not None and case.plan.object in poses.camera1_from else scene.anchor
    point = scene.objects[name].reference_point
    depth = float(transform_points(poses.camera_from(name)[view], point[None])[0, 2])
    if not depth > 0:
        return None, ""
    length = _BAR_MM * camera.sdd_mm / depth / camera.pixel_mm[1]
    return (length, f"{_BAR_MM:.0f} mm at the {name}") if length < camera.shape[1] else (None, "")


def _drr_uri(integrals: list[Tensor]) -> str:
    """A rendering as a monitor shows it, bone dark."""
    total = np.sum([image.numpy() for image in integrals], axis=0)
    bright = np.percentile(total[total > 0], 99.5) if (total > 0).any() else 1.0
    grey = (235 * (1 - total / bright)).clip(0, 235).astype(np.uint8)
    return jpeg_uri(np.repeat(grey[..., None], 3, axis=2))


def edge_uri(integral: Tensor, colour: Colour) -> str:
    """The edges of line integrals (H, W) as a picture of one colour, transparent elsewhere: its data address."""
    edges = edges_of(integral).astype(np.uint8)
    picture = Image.fromarray(cv2.dilate(edges, np.ones((2, 2), np.uint8)), "P")
    picture.putpalette([*(0, 0, 0), *colour])
    packed = io.BytesIO()
    picture.save(packed, "PNG", transparency=0, optimize=True, bits=1)
    return data_uri(packed.getvalue(), "png")


def jpeg_uri(picture: Picture) -> str:
    """A grey picture (H, W, 3) as a data address."""
    done, data = cv2.imencode(".jpg", picture[..., 0], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise OSError("a picture of the report could not be encoded as JPEG.")
    return data_uri(data.tobytes(), "jpeg")


def data_uri(data: bytes, kind: Literal["png", "jpeg"]) -> str:
    """The bytes of a picture as an address that holds them."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
