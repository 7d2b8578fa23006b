"""One fixed image, and what is drawn into it besides what a stage moves."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.geometry import Camera, Poses
from femoreg_torch.registration.compared import prepared, veil_over
from femoreg_torch.registration.imaging import Imaging, below_white, draw_still, filled, tissue_integrals
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Body, Kind, Moving, Scene
from femoreg_torch.registration.weights import Weighting, believed, pixel_weights
from femoreg_torch.similarity import FixedSimilarity, Similarity


@dataclass(frozen=True, eq=False)
class Target:
    """One fixed image with what is drawn into it."""

    view: int
    camera: Camera
    similarity: FixedSimilarity
    background: Tensor  # (H, W), line integrals of all that stands still
    moving: tuple[str, ...]
    tissue: Tensor | None  # (H, W): seen besides, or nothing
    scatter: Tensor | None  # per primary light, () or (H, W): fills shadows, or nothing
    white: Tensor | None  # (H, W), bool: where the view's first image is saturated, or nothing

    def cost(self, drawn: Tensor) -> Tensor:
        """Costs (P,) of line integrals (P, H, W)."""
        return self.similarity(self.seen(drawn))

    def seen(self, drawn: Tensor) -> Tensor:
        """Images (..., H, W) of line integrals."""
        image = filled(below_white(drawn, self.white), self.scatter)
        return image if self.tissue is None else image + self.tissue


def target_of(
    scene: Scene,
    poses: Poses,
    bodies: Sequence[Moving],
    render: Sequence[str],
    image: tuple[Kind, int],
    level: Level,
    similarity: Similarity,
    weights: Sequence[Weighting],
    imaging: Imaging,
) -> Target:
    """An image (kind, view), with all of `render` that its kind shows: drawn once where no body moves it."""
    kind, view = image
    camera = poses.camera(view, level.camera(scene.carm.camera))
    drawn = scene.shown(render, kind)
    rigid = [body for body in bodies if isinstance(body, Body)]
    moves = {name for body in rigid for name in (drawn if body.view == view and body.view else body.objects)}
    if len(rigid) < len(bodies):
        moves = set(drawn)
    still = [name for name in drawn if name not in moves]

    @functools.cache
    def alone(name: str) -> Tensor:
        return draw_still(scene.objects[name], poses.camera_from(name)[view], camera, level.step_mm)

    background = torch.zeros(camera.shape, device=scene.device)
    for name in still:
        background = background + alone(name)
    placing = [name for body in rigid for name in body.objects]
    looked_at = pixel_weights(scene, poses, render, placing, image, camera, level.step_mm, weights)
    seen = imaging.as_seen(scene.scatter)
    veil = veil_over(scene, render, image, level, imaging.scatter - seen.scatter, seen.scatter, alone)
    scatter = torch.tensor(seen.scatter, device=scene.device) if seen.scatter else None
    if veil is not None:
        scatter = seen.scatter + veil.light
    sure = believed(scene, poses, render, image, camera, level.step_mm, scatter, alone)
    if sure is not None:
        looked_at = sure if looked_at is None else looked_at * sure
    fixed = prepared(scene, image, level, similarity, looked_at, veil)
    tissue = None
    if imaging.tissue and scene.tissue is not None:
        tissue = imaging.tissue * tissue_integrals(scene.tissue, poses.camera_from(scene.anchor)[view], camera)
    white = None
    if scene.first_kind in scene.saturated and (mask := scene.saturated[scene.first_kind][view]) is not None:
        white = ~level.field(~mask, scene.carm.camera)
    return Target(view, camera, fixed, background, tuple(n for n in drawn if n in moves), tissue, scatter, white)
