"""The objective of a stage: mean similarity cost of a batch of candidate deltas (paper, equations 1, 3, 4)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera
from femoreg_torch.optimize import Objective
from femoreg_torch.registration.scene import Body, Kind, Poses, Scene, split
from femoreg_torch.similarity import GradNcc, grad_ncc


@dataclass(frozen=True)
class Level:
    """How finely a stage looks."""

    downsample: int
    step_mm: float
    patch_radius: int


@dataclass(frozen=True)
class Prior:
    """R(θ) of equation 1: the penalty weight · ½ (|rotation|² / σ² + |translation|² / σ²) on each body's motion."""

    rotation_deg: float
    translation_mm: float
    weight: float


@dataclass(frozen=True, eq=False)
class _Target:
    """One fixed image with what is drawn into it."""

    view: int
    camera: Camera
    similarity: GradNcc
    background: Tensor  # (H, W), line integrals of all that stands still
    moving: tuple[str, ...]


def _target(
    scene: Scene, poses: Poses, bodies: Sequence[Body], render: Sequence[str], kind: Kind, view: int, level: Level
) -> _Target:
    camera = scene.carm.camera.downsampled(level.downsample)
    fixed = downsample(scene.images[kind][view], level.downsample)
    drawn = [name for name in render if kind == "device" or name != "device"]
    moves = {name for body in bodies for name in (drawn if body.view == view and body.view else body.objects)}
    still = [name for name in drawn if name not in moves]
    background = torch.zeros(camera.shape)
    if still:
        where = torch.stack([poses.camera_from(name)[view] for name in still])[None]
        background = project([scene.volumes[name] for name in still], where, camera, level.step_mm)[0]
    similarity = grad_ncc(fixed, level.patch_radius)
    return _Target(view, camera, similarity, background, tuple(name for name in drawn if name in moves))


def image_costs(
    scene: Scene,
    poses: Poses,
    bodies: tuple[Body, ...],
    render: Sequence[str],
    images: Sequence[tuple[Kind, int]],
    level: Level,
) -> Callable[[Tensor], Tensor]:
    """A function from deltas (P, Σ n_b) of the bodies to similarity costs (P, len(images)).

    `images` are (kind, view) pairs. Objects of `render` that no body moves are drawn once and added.
    """
    targets = [_target(scene, poses, bodies, render, kind, view, level) for kind, view in images]

    def costs(deltas: Tensor) -> Tensor:
        motions = [body.motion(part) for body, part in zip(bodies, split(deltas, bodies), strict=True)]
        columns = []
        for target in targets:
            placed = [_camera_from(name, target.view, poses, bodies, motions, len(deltas)) for name in target.moving]
            drawn = target.background.expand(len(deltas), *target.camera.shape)
            if placed:
                volumes = [scene.volumes[name] for name in target.moving]
                drawn = drawn + project(volumes, torch.stack(placed, 1), target.camera, level.step_mm)
            columns.append(target.similarity(drawn))
        return torch.stack(columns, 1)

    return costs


def _camera_from(
    name: str, view: int, poses: Poses, bodies: tuple[Body, ...], motions: list[Tensor], candidates: int
) -> Tensor:
    """Poses (P, 4, 4) of one object in one view for every candidate."""
    in_camera1 = poses.camera1_from[name].expand(candidates, 4, 4)
    camera = poses.camera_from_camera1[view].expand(candidates, 4, 4)
    for body, motion in zip(bodies, motions, strict=True):
        if name in body.objects:
            in_camera1 = motion @ in_camera1
        if body.view and body.view == view:
            camera = motion @ camera
    return camera @ in_camera1


def stage_objective(costs: Callable[[Tensor], Tensor], bodies: tuple[Body, ...], prior: Prior | None) -> Objective:
    """Mean cost over the images, plus the prior's penalty on how far each body moves."""

    def objective(deltas: Tensor) -> Tensor:
        value = costs(deltas).mean(1)
        if prior is None:
            return value
        per_radian = 180 / torch.pi / prior.rotation_deg
        for body, part in zip(bodies, split(deltas, bodies), strict=True):
            twist = part.new_zeros(len(part), 6)
            twist[:, body.free] = part * body.scale[body.free]
            size = (twist[:, :3] * per_radian).square().sum(1) + (twist[:, 3:] / prior.translation_mm).square().sum(1)
            value = value + prior.weight * 0.5 * size
        return value

    return objective
