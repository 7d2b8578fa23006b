"""The bones at the start pose over the first view, sides named, and the device where it is meant to stand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from femoreg_torch.case import Case, StartRecord
from femoreg_torch.case.model import PlannedPath
from femoreg_torch.drr import project
from femoreg_torch.evaluation.colours import object_colours
from femoreg_torch.evaluation.overlay import monitor_picture, paint_edges, small_field
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera, Poses, project_points, transform_points
from femoreg_torch.intake.planes import Picture
from femoreg_torch.pictures import put_words
from femoreg_torch.registration import Scene, load_plan, prepare_scene
from femoreg_torch.registration.doubts.plan import doubts_about_the_guide, doubts_about_the_plan
from femoreg_torch.registration.run import network_detector
from femoreg_torch.registration.start.another_view import start_from_a_view
from femoreg_torch.registration.start.by_hand import start_by_landmarks
from femoreg_torch.registration.start.find import look_at

_WIDTH_PX = 560
_PRESET = "fast"  # whose steps look for view 1 from another view, where it shows too little
_LEAST_SHOWN = 0.25  # of a model: with less, a device may be seen by its round guide alone
_YELLOW, _MAGENTA, _WHITE = (60, 230, 255), (255, 60, 255), (255, 255, 255)


@dataclass(frozen=True, eq=False)
class StartPicture:
    """The first view with what starts in it, and how the start was found."""

    picture: Picture
    facts: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def picture_of_start(case: Case, landmarks: Mapping[str, Tensor] | None = None) -> StartPicture:
    """The start poses of a case, drawn. Raises `InputError` if there is no start, as the registration would."""
    scene = prepare_scene(case)
    record: StartRecord | None = None
    facts = [*scene.missing]
    if scene.needs_landmarks:
        if landmarks is not None:
            record = start_by_landmarks(case, scene.anchor, landmarks)
        else:
            find = network_detector(case)
            record = start_from_a_view(case, scene, load_plan(_PRESET), look_at(scene, 0, find), find, seed=0)
        used = sum(mark.used for mark in record.landmarks.values())
        counted = f", {used} landmarks within {record.reprojection_rms_px:.1f} pixels" if record.landmarks else ""
        facts.append(f"start: {record.source}{counted}")
    poses = scene.start(None if record is None else record.camera1_from_object)
    panels = [_panel(case, scene, poses, kind) for kind in scene.images if scene.images[kind][0] is not None]
    models = [name for name, thing in case.objects.items() if thing.model is not None]
    warnings = (
        *hardly_shown(scene, poses, models),
        *path_out_of_view(case.plan, scene, poses),
        *doubts_about_the_plan(case, scene),
        *doubts_about_the_guide(case, poses),
    )
    return StartPicture(np.hstack(panels), tuple(facts), warnings)


def path_out_of_view(plan: PlannedPath | None, scene: Scene, poses: Poses) -> tuple[str, ...]:
    """That both ends of the planned path lie outside the first view, if they do, in words.

    A picture that is mirrored, or taken for mirrored, starts on the patient's other side.
    """
    if plan is None or plan.object not in poses.camera1_from:
        return ()
    ends = torch.stack([plan.entry_point, plan.target])
    pixels = project_points(scene.carm.camera, transform_points(poses.camera_from(plan.object)[0], ends))
    if _in_picture(pixels, scene.carm.camera).any():
        return ()
    return (
        f"plan: where the start puts the {plan.object}, entry point and target lie beside the picture of view 1. Does "
        "it show the operated side, and are its pictures displayed as `display` says?",
    )


def _in_picture(pixels: Tensor, camera: Camera) -> Tensor:
    """Which of the points (N, 2) in pixels lie in the picture, bool."""
    last = pixels.new_tensor([camera.shape[1] - 1, camera.shape[0] - 1])
    return ((pixels >= 0) & (pixels <= last)).all(1)


def hardly_shown(scene: Scene, poses: Poses, names: Sequence[str]) -> tuple[str, ...]:
    """Which of the named objects lie in the first view with less than a quarter of their volume, in words."""
    found = []
    for name in names:
        if name not in poses.camera1_from:
            continue
        volume = scene.objects[name].volume
        inside = (volume.data > volume.data.max() / 2).nonzero().cpu().flip(1).double()
        points = transform_points(poses.camera_from(name)[0] @ volume.lps_from_index, inside)
        share = float(_in_picture(project_points(scene.carm.camera, points), scene.carm.camera).double().mean())
        if share == 0:
            beside = scene.objects[name].start.beside
            advice = (
                "The start pose must take points of its space to camera 1: is this the inverse?"
                if beside is None
                else f"It starts beside the {beside}: check `before_entry_mm`, `in_front_mm` and the guide of its "
                "`start`, or whether its transform takes points of its space to the CT"
            )
            found.append(
                f"{name}: where it is meant to stand, nothing of it lies in the picture of view 1; its middle lies "
                f"{_where(project_points(scene.carm.camera, points.mean(0)[None])[0], scene.carm.camera)}. {advice}"
            )
        elif share < _LEAST_SHOWN:
            found.append(
                f"{name}: where it is meant to stand, {100 * share:.0f} % of it lies in the picture of view 1. If the "
                "images show no more, its turn about a round guide stays open: take views that show more of it"
            )
    return tuple(found)


def _where(pixel: Tensor, camera: Camera) -> str:
    """Where a pixel (2,), column and row, lies beside the picture, in words."""
    column, row = pixel.tolist()
    height, width = camera.shape
    sides = {"left of it": -column, "right of it": column - width, "above it": -row, "below it": row - height}
    side = max(sides, key=lambda each: sides[each])
    return f"{sides[side]:.0f} pixels {side}"


def _panel(case: Case, scene: Scene, poses: Poses, kind: str) -> Picture:
    """The image of a kind in the first view, with the objects that it shows."""
    factor = max(1, scene.carm.camera.shape[1] // _WIDTH_PX)
    camera = scene.carm.camera.downsampled(factor)
    panel = monitor_picture(downsample(scene.image(kind, 0), factor), small_field(scene, kind, 0, factor))
    names = scene.shown(poses.camera1_from, kind)
    colours = object_colours(scene.objects)
    for name in names:
        pose = poses.camera_from(name)[0]
        drawn = project([scene.objects[name].volume], pose[None, None], camera)[0]
        paint_edges(panel, drawn, colours[name])
        _write(panel, camera, pose, scene.objects[name].reference_point, name, colours[name][::-1], below=14)
    if scene.anchor in poses.camera1_from:
        camera_from_ct = poses.camera_from(scene.anchor)[0]
        for mark, point in case.landmarks.items():
            _write(panel, camera, camera_from_ct, point, mark, _YELLOW)
    if case.plan is not None and case.plan.object in poses.camera1_from:
        ends = torch.stack([case.plan.entry_point, case.plan.target])
        start, end = project_points(camera, transform_points(poses.camera_from(case.plan.object)[0], ends)).tolist()
        corners = [(round(column), round(row)) for column, row in (start, end)]
        cv2.line(panel, corners[0], corners[1], _MAGENTA, 1, cv2.LINE_AA)
    put_words(panel, f"view 1, {kind}", (6, panel.shape[0] - 8), 0.45, _WHITE)
    _write_sides(panel, case, scene, poses)
    return panel


def _write_sides(panel: Picture, case: Case, scene: Scene, poses: Poses) -> None:
    """R and L where the patient's right and left are in this image."""
    if scene.anchor not in poses.camera1_from or not case.landmarks:
        return
    to_left = float(poses.camera_from(scene.anchor)[0][0, 0])
    names = ("L", "R") if to_left < 0 else ("R", "L")
    for name, column in zip(names, (8, panel.shape[1] - 22), strict=True):
        put_words(panel, name, (column, 24), 0.7, _WHITE, 2)


def _write(
    panel: Picture,
    camera: Camera,
    camera_from_object: Tensor,
    point: Tensor,
    text: str,
    colour: tuple[int, int, int],
    below: int = -4,
) -> None:
    """A cross at a point (3,) of an object, and `text` beside it, so many pixels `below`."""
    column, row = project_points(camera, transform_points(camera_from_object, point[None]))[0].tolist()
    if 0 <= column < camera.shape[1] and 0 <= row < camera.shape[0]:
        place = (round(column), round(row))
        cv2.drawMarker(panel, place, colour, cv2.MARKER_CROSS, 7, 1, cv2.LINE_AA)
        put_words(panel, text, (place[0] + 5, place[1] + below), 0.38, colour)
