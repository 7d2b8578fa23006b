"""Pixel weights of an image: which pixels a stage's similarity looks at, and how far it believes what is drawn."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, Poses, project_points
from femoreg_torch.registration.imaging import filled, filled_slope, hardened_slope
from femoreg_torch.registration.scene import Kind, Scene, Segmentation
from femoreg_torch.similarity import derivative_taps, image_gradients

# bones: the objects that the stage draws, where the network sees them. What the network does not know (an instrument)
# counts where it is drawn at its present pose.
# clear: nothing behind an instrument that the stage does not move. Instruments are what the first kind of images
# does not hold.
Weighting = Literal["bones", "clear"]

# On the detector. All chosen here: the segmentation errs by a few mm, and a gradient patch needs both sides of an edge;
# an instrument that has its place has it within 1 mm.
_BONE_MARGIN_MM = 10.0
_SHADOW_MARGIN_MM = 3.0
_LEAST_PROBABILITY = 0.5
_LEAST_SHADOW = 0.02  # line integral: two per cent of the beam
# How much an edge that may be a mistake counts against one that is drawn. Five simulated devices of several materials
# ended 0.20° off with 0, 0.15° with 1, 0.14° with 5 and with 25; ten was chosen between these.
_MISTAKES = 10.0
_PATCH_RADIUS, _SMOOTHING_PX = 5, 1.1  # of Grad-NCC in most stages of the presets
_FLAT = 1e-12  # squared change of a line integral per pixel


def pixel_weights(
    scene: Scene,
    poses: Poses,
    render: Sequence[str],
    moving: Sequence[str],
    image: tuple[Kind, int],
    camera: Camera,
    step_mm: float,
    weights: Sequence[Weighting],
) -> Tensor | None:
    """Weights (H, W), 0 or 1, of an image (kind, view) on the grid of `camera`; None where all pixels count alike.

    `render` names what the stage draws, `moving` the objects that it moves in camera 1. Raises `InputError` if no pixel
    is left, or for `bones` in a scene without segmentations.
    """
    if not weights:
        return None
    kind, view = image
    looked_at = torch.ones(camera.shape, dtype=torch.bool, device=scene.device)
    if "bones" in weights:
        looked_at &= _bones(scene, poses, scene.shown(render, kind), view, camera, step_mm)
    if "clear" in weights:
        placed = scene.shown(poses.camera1_from, kind)
        still = [name for name in placed if scene.first_kind not in scene.objects[name].shown_in and name not in moving]
        looked_at &= ~dilated(_silhouette(scene, poses, still, view, camera, step_mm), _SHADOW_MARGIN_MM, camera)
    if not looked_at.any():
        raise InputError(
            f"view {view + 1}, {kind} image: weights [{', '.join(weights)}] leave no pixel to compare. Does it show "
            f"{', '.join(render)}? Otherwise take `weights` out of the stage."
        )
    return looked_at.float()


def believed(
    scene: Scene,
    poses: Poses,
    render: Sequence[str],
    image: tuple[Kind, int],
    camera: Camera,
    step_mm: float,
    scatter: Tensor | None,
    alone: Callable[[str], Tensor],
) -> Tensor | None:
    """Weights (H, W), 0 to 1, of an image (kind, view): lower where what is drawn may be wrong; None where all is sure.

    Light per primary light, `scatter`, fills the shadows, see `imaging.filled`. `alone` tells the line integrals (H, W)
    of an object by itself.

    Where the materials of an object were estimated, a block at the border of two may be drawn as the wrong one. That
    draws edges which the image does not have, and a strong one outweighs the faint true ones of its patch. With g² the
    squared derivatives of what is drawn, and u² those of what is `unsure`, both summed over a patch, the patch weighs
    g² / (g² + 10 u²).
    """
    kind, view = image
    names = scene.shown(render, kind)
    unsure = [name for name in names if scene.objects[name].unsure]
    if not unsure:
        return None
    drawn = torch.stack([alone(name) for name in names]).sum(0)
    slope = filled_slope(drawn, scatter)
    mistakes = torch.zeros_like(drawn)
    for name in unsure:
        seen = slope * hardened_slope(alone(name), scene.objects[name].hardening)
        where = poses.camera_from(name)[view][None, None]
        for difference in scene.objects[name].unsure:
            mistakes += _edges(seen * project([difference], where, camera, step_mm)[0])
    edges, mistakes = (_over_patches(of) for of in (_edges(filled(drawn, scatter)), mistakes))
    return (edges + _FLAT) / (edges + _MISTAKES * mistakes + _FLAT)


def _edges(image: Tensor) -> Tensor:
    """Squared length (H, W) of the derivatives of an image (H, W)."""
    return image_gradients(image[None], derivative_taps(_SMOOTHING_PX, image.device))[0].square().sum(0)


def _over_patches(image: Tensor) -> Tensor:
    """The mean (H, W) around each pixel of an image (H, W)."""
    return F.avg_pool2d(image[None], 2 * _PATCH_RADIUS + 1, 1, _PATCH_RADIUS)[0]


def _bones(scene: Scene, poses: Poses, names: Sequence[str], view: int, camera: Camera, step_mm: float) -> Tensor:
    """The pixels (H, W) near the named objects."""
    if not scene.segmentations:
        raise InputError("weights [bones]: the scene has no segmentations. Add them with `with_segmentations`.")
    classes = sorted({label for name in names for label in scene.objects[name].classes})
    segmentation = scene.segmentations[view]
    segmentation = replace(segmentation, camera=poses.camera(view, segmentation.camera))  # on the same detector
    seen = _on_grid(segmentation, camera)[classes].sum(0) >= _LEAST_PROBABILITY
    unknown = [name for name in names if not scene.objects[name].classes]
    return dilated(seen | _silhouette(scene, poses, unknown, view, camera, step_mm), _BONE_MARGIN_MM, camera)


def _on_grid(segmentation: Segmentation, camera: Camera) -> Tensor:
    """Probabilities (C, H, W) on the grid of another camera with the same detector; zero beyond the border."""
    pixels = project_points(segmentation.camera, camera.pixel_positions())
    size = torch.tensor(segmentation.camera.shape[::-1], dtype=torch.float64)
    unit = ((2 * pixels + 1) / size - 1).to(segmentation.probabilities)  # pixel centres to grid_sample's −1 … 1
    return F.grid_sample(segmentation.probabilities[None], unit[None], align_corners=False)[0]


def _silhouette(scene: Scene, poses: Poses, names: Sequence[str], view: int, camera: Camera, step_mm: float) -> Tensor:
    """The pixels (H, W) that the named objects cover at `poses`."""
    if not names:
        return torch.zeros(camera.shape, dtype=torch.bool, device=scene.device)
    where = torch.stack([poses.camera_from(name)[view] for name in names])[None]
    return project([scene.objects[name].volume for name in names], where, camera, step_mm)[0] > _LEAST_SHADOW


def dilated(mask: Tensor, margin_mm: float, camera: Camera) -> Tensor:
    """The pixels (H, W) that are closer than a margin on the detector, along rows and columns, to those of a mask."""
    rows, columns = (math.ceil(margin_mm / pixel_mm) for pixel_mm in camera.pixel_mm)
    return F.max_pool2d(mask[None].float(), (2 * rows + 1, 2 * columns + 1), 1, (rows, columns))[0] > 0
