"""Replay of a registration: edges of the structures over the fluoroscopy, moment by moment as the search went on."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from femoreg_torch.case import Case, Result, Verdict
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.fit import check_fits
from femoreg_torch.evaluation.overlay import GREEN, RED, Picture, edges_of, monitor_picture, new_objects, small_field
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera, Poses
from femoreg_torch.registration import Scene, prepare_scene
from femoreg_torch.registration.scene import Kind
from femoreg_torch.similarity import FixedSimilarity, GradNcc, against_field

_PANEL_PX = 256  # width of one image, or a little more: the detector is averaged over whole blocks
_BAR_PX = 22  # height of a line of text
_PATCH_RADIUS = 5  # of the similarity that is told below each image, pixels
_MOMENT_MS, _STAGE_MS, _END_MS = 120, 700, 4000
_WHITE, _GREY = (235, 235, 235), (150, 150, 150)


@dataclass(frozen=True, eq=False)
class Frame:
    """A moment of a registration: what is told of it, the poses, and what has its place by then."""

    stage: str
    detail: str
    poses: Poses
    views: frozenset[int]  # from 0
    objects: frozenset[str]
    milliseconds: int


def write_replay(path: Path, case: Case, result: Result) -> None:
    """Write the replay of a result as an animated GIF, whole or not at all.

    Raises `InputError` for another suffix, or a result that does not fit the case or holds no moments.
    """
    if path.suffix.lower() != ".gif":
        raise InputError(f"{path}: the replay is an animated GIF. Choose a name that ends in .gif.")
    check_fits(case, result)
    scene = prepare_scene(case)
    frames = list(frames_of(result, scene))
    pictures = [_indexed(picture) for picture in draw_frames(case, scene, frames, _verdict(result.verdict))]
    with temporary_file(path) as part:
        pictures[0].save(
            part,
            save_all=True,
            append_images=pictures[1:],
            duration=[frame.milliseconds for frame in frames],
            loop=0,
        )


def frames_of(result: Result, scene: Scene) -> Iterator[Frame]:
    """The start pose, the moments of every stage, and the end.

    Raises `InputError` if the result does not tell where it started, or holds stages without moments.
    """
    if result.start is None:
        raise InputError("the result does not tell where it started, so there is nothing to replay. Register again.")
    if not any(stage.moments for stage in result.stages):
        raise InputError("no stage of the result holds moments, so there is nothing to replay. Register again.")
    poses = scene.start(result.start.camera1_from_object)
    poses = Poses(
        poses.camera_from_camera1, {n: p for n, p in poses.camera1_from.items() if n in result.poses.camera1_from}
    )
    views = frozenset({0}) if scene.camera_from_camera1 is None else frozenset(range(scene.views))
    # what is seen in the first images lies near its place from the start; what comes with others, when it has moved
    objects = frozenset(name for name in scene.shown(poses.camera1_from, scene.first_kind))
    yield Frame(f"start: {result.start.source}", "", poses, views, objects, _STAGE_MS)
    for number, stage in enumerate(result.stages, 1):
        if stage.view is not None:
            views |= {stage.view - 1}
        elif not torch.equal(stage.poses.camera_from_camera1, poses.camera_from_camera1):
            views |= set(range(scene.views))
        objects |= {
            name
            for name, pose in stage.poses.camera1_from.items()
            if name in poses.camera1_from and not torch.equal(pose, poses.camera1_from[name])
        }
        name = f"{number}/{len(result.stages)} {stage.name}"
        name += f", view {stage.view}" if stage.view is not None else ""
        for moment in stage.moments:
            yield Frame(name, _detail(moment.evaluations, moment.cost), moment.poses, views, objects, _MOMENT_MS)
        poses = stage.poses
        end = _END_MS if number == len(result.stages) else _STAGE_MS
        yield Frame(name, _detail(stage.evaluations, stage.cost), poses, views, objects, end)


def _detail(evaluations: int, cost: float) -> str:
    return f"{evaluations} evaluations, cost {cost:.4f}"


def _verdict(verdict: Verdict) -> tuple[str, tuple[int, int, int]]:
    """What the last line says, and its colour."""
    return ("trusted: every check passed", GREEN) if verdict.trusted else ("NOT TRUSTED: see the report", RED)


def draw_frames(
    case: Case, scene: Scene, frames: list[Frame], verdict: tuple[str, tuple[int, int, int]]
) -> Iterator[Picture]:
    """Pictures (H, W, 3) of frames: a column per view, a row per kind of images, lines of text around them.

    `verdict` is told on the last one.
    """
    factor = max(1, scene.carm.camera.shape[1] // _PANEL_PX)
    camera = scene.carm.camera.downsampled(factor)
    new = new_objects(scene)
    backgrounds: dict[tuple[Kind, int], Picture] = {}
    similarities: dict[tuple[Kind, int], FixedSimilarity] = {}
    for kind, images in scene.images.items():
        for number, image in enumerate(images):
            if image is None:
                continue
            small = downsample(image, factor)
            field = small_field(scene, kind, number, factor)
            backgrounds[kind, number] = monitor_picture(small, field)
            similarities[kind, number] = against_field(GradNcc(_PATCH_RADIUS), small, None, field)
    renderer = _Renderer(scene, camera)
    for index, frame in enumerate(frames):
        rows = []
        for kind in scene.images:
            drawn = [name for name in scene.shown(frame.poses.camera1_from, kind) if name in frame.objects]
            edged = [name for name in new[kind] if name in drawn]
            panels = [
                _panel(backgrounds[kind, view].copy(), view, edged, drawn, frame, renderer, similarities[kind, view])
                if (kind, view) in backgrounds
                else np.zeros((*camera.shape, 3), np.uint8)
                for view in range(scene.views)
            ]
            rows.append(np.hstack(panels))
        width = rows[0].shape[1]
        end = index == len(frames) - 1
        simulated = case.truth is not None and case.anchor in case.truth.camera1_from  # a measured truth lacks it
        note = "simulated images; " if simulated else ""
        foot = [(f"{note}research software, not a medical device", _GREY), verdict if end else ("", _GREY)]
        yield np.vstack([_bar(width, (frame.stage, _WHITE), (frame.detail, _WHITE)), *rows, _bar(width, *foot)])


class _Renderer:
    """DRRs of the objects in the views, the last one of each kept: from frame to frame most stand still."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self._scene, self._camera = scene, camera
        self._last: dict[tuple[str, int], tuple[Camera, Tensor, Tensor]] = {}

    def __call__(self, poses: Poses, name: str, view: int) -> Tensor:
        """Line integrals (H, W) of one object in one view."""
        camera_from_object = poses.camera_from(name)[view]
        camera = poses.camera(view, self._camera)
        last = self._last.get((name, view))
        if last is not None and last[0] == camera and torch.equal(last[1], camera_from_object):
            return last[2]
        drawn = project([self._scene.objects[name].volume], camera_from_object[None, None], camera)[0]
        self._last[name, view] = (camera, camera_from_object, drawn)
        return drawn


def _panel(
    picture: Picture,
    view: int,
    edged: list[str],
    drawn: list[str],
    frame: Frame,
    renderer: _Renderer,
    similarity: FixedSimilarity,
) -> Picture:
    """One image with the edges of what it shows first and has its place by then, and the similarity of all drawn."""
    if view not in frame.views or not edged:
        picture //= 2
        return picture
    for name in edged:
        picture[edges_of(renderer(frame.poses, name, view))] = GREEN
    total = torch.stack([renderer(frame.poses, name, view) for name in drawn]).sum(0)
    text = f"view {view + 1}, similarity {1 - float(similarity(total[None])[0]):.3f}"
    picture[-_BAR_PX:] //= 3
    cv2.putText(picture, text, (6, picture.shape[0] - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)
    return picture


def _bar(width: int, left: tuple[str, tuple[int, int, int]], right: tuple[str, tuple[int, int, int]]) -> Picture:
    bar = np.zeros((_BAR_PX, width, 3), np.uint8)
    (size, _), _ = cv2.getTextSize(right[0], cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    for (text, colour), column in ((left, 6), (right, width - size - 6)):
        cv2.putText(bar, text, (column, _BAR_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
    return bar


def _palette() -> NDArray[np.uint8]:
    """Colours (256, 3) of all frames, RGB: greys, and ramps to green and red. The same for all, so nothing flickers."""
    colours = np.zeros((256, 3), np.uint8)
    colours[:192] = np.linspace(0, 255, 192)[:, None]
    colours[192:224, 1] = np.linspace(8, 255, 32)
    colours[224:] = np.linspace(0.03, 1, 32)[:, None] * np.array(RED[::-1])
    return colours


def _indexed(picture: Picture) -> Image.Image:
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette().tobytes())
    return Image.fromarray(picture[..., ::-1]).quantize(palette=palette, dither=Image.Dither.NONE)
