"""Replay of a registration: edges of the structures over the fluoroscopy, moment by moment as the search went on."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from femoreg_torch.case import RESULT_NAME, Case
from femoreg_torch.case.fields import Fields
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.overlay import GREEN, RED, Picture, edges_of, monitor_picture
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera
from femoreg_torch.registration import Poses, Scene, prepare_scene
from femoreg_torch.registration.scene import Kind, first_view_only
from femoreg_torch.similarity import GradNcc, grad_ncc

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


def write_replay(path: Path, case: Case, result: dict[str, Any]) -> None:
    """Write the replay of a result as an animated GIF, whole or not at all.

    `result` is what `read_result` gives. Raises `InputError` for another suffix, or a result that does not fit the case
    or holds no moments.
    """
    if path.suffix.lower() != ".gif":
        raise InputError(f"{path}: the replay is an animated GIF. Choose a name that ends in .gif.")
    frames = list(frames_of(result, case))
    pictures = [_indexed(picture) for picture in draw_frames(case, prepare_scene(case), frames, _verdict(result))]
    with temporary_file(path) as part:
        pictures[0].save(
            part,
            save_all=True,
            append_images=pictures[1:],
            duration=[frame.milliseconds for frame in frames],
            loop=0,
        )


def frames_of(result: dict[str, Any], case: Case) -> Iterator[Frame]:
    """The start pose, the moments of every stage, and the end, from the content of a result.

    Raises `InputError` if it holds no stages with moments or is of another number of views.
    """
    top = Fields(result, RESULT_NAME)
    if len(result["camera_from_pelvis"]) != len(case.views):
        raise InputError(
            f"{RESULT_NAME}: {len(result['camera_from_pelvis'])} views, but {case.folder} has {len(case.views)}. Name "
            "the case that was registered."
        )
    pelvis = top.mapping("start").transform("camera1_from_pelvis")
    start = {"pelvis": pelvis, "femur": pelvis}
    if "camera1_from_device" in result and case.device is not None:
        start["device"] = case.device.camera1_from_device
    poses, views, objects = first_view_only(start, len(case.views)), frozenset({0}), frozenset({"pelvis", "femur"})
    yield Frame("start: landmarks of the network, PnP", "", poses, views, objects, _STAGE_MS)
    stages = top.mappings("stages")
    for number, stage in enumerate(stages, 1):
        after = _poses(stage, poses)
        if "view" in stage:
            views |= {int(stage.number("view")) - 1}
        if not torch.equal(after.camera1_from.get("device", pelvis), poses.camera1_from.get("device", pelvis)):
            objects |= {"device"}
        name = f"{number}/{len(stages)} {stage.value('name', 'the name of the stage')}"
        name += f", view {int(stage.number('view'))}" if "view" in stage else ""
        if "moments" not in stage:
            raise InputError(f"{stage.where('moments')}: missing, so there is nothing to replay. Register again.")
        for moment in stage.mappings("moments"):
            yield Frame(name, _detail(moment), _poses(moment, poses), views, objects, _MOMENT_MS)
        poses = after
        yield Frame(name, _detail(stage), poses, views, objects, _END_MS if number == len(stages) else _STAGE_MS)


def _detail(fields: Fields) -> str:
    return f"{int(fields.number('evaluations'))} evaluations, cost {fields.number('cost'):.4f}"


def _poses(fields: Fields, before: Poses) -> Poses:
    """The poses before, with those that stand in `fields` in their place."""
    poses = before
    if "camera_from_camera1" in fields:
        poses = Poses(fields.transforms("camera_from_camera1"), poses.camera1_from)
    placed = fields.mapping("camera1_from")
    for name in placed.content:
        poses = poses.with_object(name, placed.transform(name))
    return poses


def _verdict(result: dict[str, Any]) -> tuple[str, tuple[int, int, int]]:
    """What the last line says, and its colour."""
    if result.get("trusted") is True:
        return "no check of the registration failed", GREEN
    return "NOT TO BE TRUSTED: see quality in result.json", RED


def draw_frames(
    case: Case, scene: Scene, frames: list[Frame], verdict: tuple[str, tuple[int, int, int]]
) -> Iterator[Picture]:
    """Pictures (H, W, 3) of frames: a column per view, anatomy above and device below, lines of text around them.

    `verdict` is told on the last one.
    """
    camera = scene.carm.camera.downsampled(max(1, scene.carm.camera.shape[1] // _PANEL_PX))
    factor = scene.carm.camera.shape[1] // camera.shape[1]
    kinds: list[Kind] = [kind for kind in ("anatomy", "device") if kind in scene.images]
    backgrounds: dict[tuple[Kind, int], Picture] = {}
    similarities: dict[tuple[Kind, int], GradNcc] = {}
    for number, view in enumerate(case.views):
        for kind in kinds:
            image = view.anatomy if kind == "anatomy" or view.device is None else view.device
            backgrounds[kind, number] = monitor_picture(image, view.intensity, case, camera)
            similarities[kind, number] = grad_ncc(downsample(scene.images[kind][number], factor), _PATCH_RADIUS)
    renderer = _Renderer(scene, camera)
    for index, frame in enumerate(frames):
        rows = []
        for kind in kinds:
            panels = [
                _panel(backgrounds[kind, view].copy(), kind, view, frame, renderer, similarities[kind, view])
                for view in range(len(case.views))
            ]
            rows.append(np.hstack(panels))
        width = rows[0].shape[1]
        end = index == len(frames) - 1
        note = "simulated images; " if case.truth is not None else ""
        foot = [(f"{note}research software, not a medical device", _GREY), verdict if end else ("", _GREY)]
        yield np.vstack([_bar(width, (frame.stage, _WHITE), (frame.detail, _WHITE)), *rows, _bar(width, *foot)])


class _Renderer:
    """DRRs of the objects in the views, the last one of each kept: from frame to frame most stand still."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self._scene, self._camera = scene, camera
        self._last: dict[tuple[str, int], tuple[Tensor, Tensor]] = {}

    def __call__(self, poses: Poses, name: str, view: int) -> Tensor:
        """Line integrals (H, W) of one object in one view."""
        camera_from_object = poses.camera_from(name)[view]
        where, drawn = self._last.get((name, view), (None, None))
        if drawn is None or where is None or not torch.equal(where, camera_from_object):
            drawn = project([self._scene.objects[name].volume], camera_from_object[None, None], self._camera)[0]
            self._last[name, view] = (camera_from_object, drawn)
        return drawn


def _panel(picture: Picture, kind: Kind, view: int, frame: Frame, renderer: _Renderer, similarity: GradNcc) -> Picture:
    """One image with what has its place in it by then, and the similarity of all that is drawn."""
    shown = frame.objects & ({"device"} if kind == "device" else {"pelvis", "femur"})
    if view not in frame.views or not shown:
        picture //= 2
        return picture
    for name in sorted(shown):
        picture[edges_of(renderer(frame.poses, name, view))] = GREEN
    names = sorted(frame.objects if kind == "device" else shown)
    total = torch.stack([renderer(frame.poses, name, view) for name in names]).sum(0)
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
