"""The 3-D scene of a report: surfaces of the objects, planned path, guide and C-arm, small enough to lie in a page."""

import base64
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.case import Case, Result
from femoreg_torch.evaluation.colours import GUIDE, PATH, hexadecimal, object_colours
from femoreg_torch.evaluation.overlay import Drawn
from femoreg_torch.evaluation.report.pictures import jpeg_uri
from femoreg_torch.geometry import Camera, invert_rigid, transform_points
from femoreg_torch.registration import Scene
from femoreg_torch.volume import Volume

_MOST_VOXELS = 400_000  # of the box around an object: about 30,000 triangles of a pelvis
_SOLID = 0.1  # of the attenuation that 98 % of what is there does not exceed: what counts as inside
_OPACITY = 0.5  # of objects, so that path and guide are seen inside
_ROD_MM = 1.5  # radius of path and guide
_DETECTOR_PX = 256  # width of the image on a detector
_BEAM_COLOUR = (150, 160, 175)

Array = NDArray[np.float64]


def theatre(case: Case, scene: Scene, result: Result, drawn: Drawn) -> dict[str, Any]:
    """What `templates/theatre.js` draws, ready for JSON. Points are mm in camera 1, the camera of view 1."""
    poses, colours = result.poses, object_colours(scene.objects)
    meshes = []
    for name, pose in poses.camera1_from.items():
        surface = surface_of(scene.objects[name].volume)
        if surface is not None:
            corners, faces = surface
            moved = transform_points(pose, torch.from_numpy(corners)).numpy()
            meshes.append(_mesh(name, moved, faces, hexadecimal(colours[name]), _OPACITY))
    meshes += _rods(case, result)
    centre = transform_points(poses.camera1_from[scene.anchor], scene.objects[scene.anchor].reference_point[None])[0]
    return {
        "meshes": meshes,
        "views": [_view(result, drawn, view) for view in range(scene.views)],
        "labels": list(_labels(case, scene, result)),
        "centre": [round(value, 1) for value in centre.tolist()],
        "beam": hexadecimal(_BEAM_COLOUR),
    }


def surface_of(volume: Volume) -> tuple[Array, NDArray[np.int64]] | None:
    """Corners (N, 3), mm in the volume's space, and triangles (M, 3) around what attenuates; None if nothing does.

    The volume is averaged over whole blocks of voxels until few enough are left; cavities, such as the marrow's, are
    filled.
    """
    there = volume.data > 0
    if not there.any():
        return None
    level = _SOLID * float(np.quantile(volume.data[there].numpy(), 0.98))
    inside = (volume.data > level).nonzero()
    low, high = inside.min(0).values, inside.max(0).values + 1
    (z0, y0, x0), (z1, y1, x1) = low.tolist(), high.tolist()
    box = (volume.data[z0:z1, y0:y1, x0:x1] > level).float()
    factor = max(1, math.ceil((box.numel() / _MOST_VOXELS) ** (1 / 3)))
    padding = [side for length in reversed(box.shape) for side in (factor, factor + -length % factor)]
    share = F.avg_pool3d(F.pad(box, padding)[None, None], factor)[0, 0].numpy()
    filled = np.maximum(share, ndimage.binary_fill_holes(share > 0.5))
    from skimage.measure import (
        marching_cubes,  # as trimesh below: `femoreg register` imports this room and draws nothing
    )

    corners, faces, _, _ = marching_cubes(ndimage.gaussian_filter(filled, 0.6), 0.4)
    index = (corners[:, ::-1] + 0.5) * factor - 0.5 - factor + np.array([x0, y0, z0])  # x, y, z of the whole volume
    points = transform_points(volume.lps_from_index, torch.from_numpy(np.ascontiguousarray(index, np.float64)))
    return points.numpy(), faces.astype(np.int64)


def _mesh(name: str, corners: Array, faces: NDArray[np.int64], colour: str, opacity: float) -> dict[str, Any]:
    """A mesh with its corners as 16-bit steps of its bounding box."""
    low, high = corners.min(0), corners.max(0)
    step = np.maximum(high - low, 1e-6) / 65535
    return {
        "name": name,
        "colour": colour,
        "opacity": opacity,
        "low": low.round(3).tolist(),
        "step": step.tolist(),
        "corners": _packed(((corners - low) / step).round().astype("<u2")),
        "faces": _packed(faces.astype("<u4")),
    }


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")


def _rods(case: Case, result: Result) -> Iterator[dict[str, Any]]:
    """Planned path and guide as thin rods, and a ball at the entry point."""
    plan, poses = case.plan, result.poses.camera1_from
    if plan is None or plan.object not in poses:
        return
    entry, target = transform_points(poses[plan.object], torch.stack([plan.entry_point, plan.target])).numpy()
    yield _rod("planned path", entry, target, hexadecimal(PATH))
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=2.5 * _ROD_MM)
    yield _mesh("entry point", np.asarray(ball.vertices) + entry, np.asarray(ball.faces), hexadecimal(PATH), 1.0)
    if plan.tool is not None and plan.tool in poses:
        points = case.objects[plan.tool].points
        base, tip = transform_points(poses[plan.tool], torch.stack([points["base"], points["tip"]])).numpy()
        yield _rod("guide axis", base, tip, hexadecimal(GUIDE))


def _rod(name: str, start: Array, end: Array, colour: str) -> dict[str, Any]:
    import trimesh

    rod = trimesh.creation.cylinder(radius=_ROD_MM, segment=np.stack([start, end]), sections=12)
    return _mesh(name, np.asarray(rod.vertices), np.asarray(rod.faces), colour, 1.0)


def _view(result: Result, drawn: Drawn, view: int) -> dict[str, Any]:
    """Source, the four corners of the detector (clockwise from the first pixel) and the first image of a view."""
    camera1_from_camera = invert_rigid(result.poses.camera_from_camera1[view])
    corners = torch.cat([torch.zeros(1, 3, dtype=torch.float64), _detector_corners(drawn.cameras[view])])
    points = transform_points(camera1_from_camera, corners)
    picture = next((p for (_, number), p in drawn.images.items() if number == view), None)
    image = None
    if picture is not None:
        height = round(_DETECTOR_PX * picture.shape[0] / picture.shape[1])
        small = cv2.resize(picture, (_DETECTOR_PX, height), interpolation=cv2.INTER_AREA)
        image = jpeg_uri(np.asarray(small, np.uint8))
    source, *detector = [[round(value, 2) for value in point] for point in points.tolist()]
    return {"name": f"view {view + 1}", "source": source, "detector": detector, "image": image}


def _detector_corners(camera: Camera) -> Tensor:
    """The outer corners (4, 3) of the detector in its camera, mm."""
    rows, columns = camera.shape
    pixels = [(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)]
    x0, y0 = camera.principal_point_px
    places = [((x - x0) * camera.pixel_mm[1], (y - y0) * camera.pixel_mm[0], camera.sdd_mm) for x, y in pixels]
    return torch.tensor(places, dtype=torch.float64)


def _labels(case: Case, scene: Scene, result: Result) -> Iterator[dict[str, Any]]:
    """Names of views, and of the patient's directions (LPS) around a bone of the CT."""
    bone = next((name for name in result.poses.camera1_from if case.objects[name].model is None), None)
    if bone is None:
        return
    pose, thing = result.poses.camera1_from[bone], scene.objects[bone]
    size = torch.tensor(thing.volume.data.shape[::-1], dtype=torch.float64)
    reach = 0.6 * float((size * torch.tensor(thing.volume.spacing_mm, dtype=torch.float64)).max())
    middle = transform_points(pose, thing.volume.centre()[None])[0]
    for axis, (plus, minus) in enumerate((("left", "right"), ("back", "front"), ("head", "feet"))):
        for name, sign in ((plus, 1), (minus, -1)):
            place = middle + sign * reach * pose[:3, axis]
            yield {"text": name, "at": [round(value, 1) for value in place.tolist()]}
