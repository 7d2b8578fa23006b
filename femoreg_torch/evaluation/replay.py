"""Replay of a registration: edges of the structures over the fluoroscopy, moment by moment as the search went on."""

import errno
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from femoreg_torch.case import Case, Result, Verdict
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.colours import OBJECT_COLOURS, Colour
from femoreg_torch.evaluation.fit import check_fits, check_made_of
from femoreg_torch.evaluation.overlay import (
    Picture,
    Renderer,
    monitor_picture,
    new_objects,
    paint_edges,
    small_field,
)
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Poses
from femoreg_torch.registration import Scene, prepare_scene
from femoreg_torch.registration.scene import Kind
from femoreg_torch.similarity import FixedSimilarity, GradNcc, against_field

_PANEL_PX = 256  # width of one image, or a little more: the detector is averaged over whole blocks
_BAR_PX = 22  # height of a line of text
_PATCH_RADIUS = 5  # of the similarity that is told below each image, pixels
_MOMENT_MS, _STAGE_MS, _END_MS = 120, 700, 4000
_FPS = 25
_CODECS = {".mp4": ("libx264",), ".webm": ("libvpx-vp9", "-deadline", "realtime", "-cpu-used", "8")}  # codec, options
SUFFIXES = (".gif", *_CODECS)
REPLAY_NAMES = tuple(f"replay{suffix}" for suffix in SUFFIXES)
_WHITE, _GREY = (235, 235, 235), (150, 150, 150)
_GOOD, _BAD = (233, 180, 86), (60, 60, 255)  # blue, green, red


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
    """Write the replay of a result, whole or not at all: an animated GIF, or a film as MP4 (H.264) or WebM (VP9).

    Raises `InputError` for another suffix, or a result that does not fit the case or holds no moments.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: the replay is a moving picture. Choose a name that ends in {', '.join(SUFFIXES)}.")
    check_fits(case, result)
    check_made_of(case, result)
    scene = prepare_scene(case)
    frames = list(frames_of(result, scene))
    pictures = draw_frames(case, scene, frames, _verdict(result.verdict))
    durations = [frame.milliseconds for frame in frames]
    write = _write_gif if suffix == ".gif" else write_film
    with temporary_file(path) as part:
        write(part, pictures, durations)


def _write_gif(path: Path, pictures: Iterator[Picture], durations: list[int]) -> None:
    first, *others = [_indexed(picture) for picture in pictures]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def write_film(path: Path, pictures: Iterator[Picture], durations: list[int]) -> None:
    """Write pictures (H, W, 3), each shown for so many milliseconds, as a film in the format of the path's suffix.

    Raises `OSError` if it is cut off, of which ffmpeg says nothing.
    """
    import imageio_ffmpeg

    codec, *options = _CODECS[path.suffix.lower()]
    writer, sent = None, 0
    for picture, milliseconds in zip(pictures, durations, strict=True):
        rows, columns, _ = picture.shape
        even = np.pad(picture, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")  # as the codecs need it
        if writer is None:
            writer = imageio_ffmpeg.write_frames(
                str(path),
                (even.shape[1], even.shape[0]),
                pix_fmt_in="bgr24",
                fps=_FPS,
                codec=codec,
                output_params=options,
                macro_block_size=2,
                ffmpeg_log_level="error",
            )
            writer.send(None)
        for _ in range(max(1, round(milliseconds * _FPS / 1000))):
            writer.send(np.ascontiguousarray(even))
            sent += 1
    if writer is None:
        return
    writer.close()
    try:
        written = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
    except RuntimeError:  # no film at all
        written = 0
    if written < sent:
        raise OSError(errno.ENOSPC, "cannot be written whole. Is the disk full?")


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
    return ("trusted: every check passed", _GOOD) if verdict.trusted else ("NOT TRUSTED: see the report", _BAD)


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
    renderer = Renderer(scene, camera)
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
        note = "simulated images; " if case.truth_source == "simulation" else ""
        foot = [(f"{note}research software, not a medical device", _GREY), verdict if end else ("", _GREY)]
        yield np.vstack([_bar(width, (frame.stage, _WHITE), (frame.detail, _WHITE)), *rows, _bar(width, *foot)])


def _panel(
    picture: Picture,
    view: int,
    edged: list[str],
    drawn: list[str],
    frame: Frame,
    renderer: Renderer,
    similarity: FixedSimilarity,
) -> Picture:
    """One image with the edges of what it shows first and has its place by then, and the similarity of all drawn."""
    if view not in frame.views or not edged:
        picture //= 2
        return picture
    for name in edged:
        paint_edges(picture, renderer(frame.poses, name, view), renderer.colours[name])
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
    """Colours (256, 3) of all frames, RGB: greys, and a ramp to each colour. The same for all, so nothing flickers."""
    ramps: tuple[Colour, ...] = (*OBJECT_COLOURS, (_BAD[2], _BAD[1], _BAD[0]))
    steps = 16
    greys = 256 - steps * len(ramps)
    colours = np.zeros((256, 3), np.uint8)
    colours[:greys] = np.linspace(0, 255, greys)[:, None]
    for number, ramp in enumerate(ramps):
        first = greys + number * steps
        colours[first : first + steps] = np.linspace(0.2, 1, steps)[:, None] * np.array(ramp)
    return colours


def _indexed(picture: Picture) -> Image.Image:
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette().tobytes())
    return Image.fromarray(picture[..., ::-1]).quantize(palette=palette, dither=Image.Dither.NONE)
