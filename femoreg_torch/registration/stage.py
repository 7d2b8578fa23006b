"""A stage: one optimisation of bodies over images, or one for each other view."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import torch

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import Optimiser
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.moments import moments_of
from femoreg_torch.registration.objective import PLAIN, Imaging, Prior, image_costs, stage_objective
from femoreg_torch.registration.restarts import restarts_of
from femoreg_torch.registration.scene import Body, Kind, Scene, moved, reference_point_in_view
from femoreg_torch.registration.step import (
    ALL,
    CARM_IS_KNOWN,
    ONE_VIEW,
    check_placed,
    chosen_kinds,
    chosen_objects,
    lacking,
)
from femoreg_torch.registration.weights import Weighting
from femoreg_torch.similarity import Similarity

EACH, VIEW, VIEWS = "each", "view", "views"


@dataclass(frozen=True)
class BodyPlan:
    """A body to move: `move` names objects of the scene that move together, or the C-arm of a view.

    [all] are all objects together, [each] stands for one body per object that the stage's images show. [view] is the
    C-arm of the view at hand in a stage for each other view, [views] stands for one body per view but the first; both
    are left out where the C-arm's poses are given. `rotation_deg` and `translation_mm` are per axis of the camera (x
    along columns, y along rows, z depth): the standard deviation of random candidates for CMA-ES and
    Levenberg–Marquardt, the half-width of the box for BOBYQA. Zero freezes an axis. `centre` names the object whose
    reference point it turns about: by default its own, that of the first if several are named, and for [all], [view]
    and [views] that of the scene's anchor.
    """

    move: list[str]
    rotation_deg: list[float]
    translation_mm: list[float]
    centre: str | None = None

    def __post_init__(self) -> None:
        if len(self.rotation_deg) != 3 or len(self.translation_mm) != 3:
            raise InputError("rotation_deg and translation_mm need three numbers, one per camera axis.")
        if not self.move:
            raise InputError("a body: `move` names nothing.")

    @property
    def is_carm(self) -> bool:
        """Whether it is the C-arm that moves."""
        return self.move in ([VIEW], [VIEWS])

    def names(self, scene: Scene, poses: Poses) -> set[str]:
        """The names of all objects that it moves or turns about."""
        if self.move == [EACH]:
            return set() if self.centre is None else {self.centre}
        moving = [] if self.is_carm else chosen_objects(self.move, poses)
        return {*moving, self._about(scene, moving)}

    def bodies(self, scene: Scene, poses: Poses, kinds: list[Kind], views: tuple[int, ...]) -> list[Body]:
        """The bodies that it stands for in images of the given kinds and views (from 0)."""
        scale = torch.tensor([*self.rotation_deg, *self.translation_mm], dtype=torch.float64)
        scale[:3] *= torch.pi / 180

        def body(names: list[str], view: int) -> Body:
            return Body(
                tuple(names), view, reference_point_in_view(scene, poses, self._about(scene, names), view), scale
            )

        if self.is_carm:
            return [body([], view) for view in views if view and scene.camera_from_camera1 is None]
        if self.move == [EACH]:
            return [body([name], 0) for name in poses.camera1_from if any(scene.shown([name], kind) for kind in kinds)]
        return [body(chosen_objects(self.move, poses), 0)]

    def _about(self, scene: Scene, moving: list[str]) -> str:
        """The object whose reference point a body turns about."""
        return self.centre or (moving[0] if moving and self.move != [ALL] else scene.anchor)


@dataclass(frozen=True)
class Stage:
    """One optimisation. `images` says which views take part: the first, each other view by itself, or all together.

    Objects are named as in the scene; [all] in `render` or `kinds` stands for all. `weights` says which pixels count,
    see `pixel_weights`; by default all do. `imaging` says what is drawn besides the objects; by default nothing.
    """

    name: str
    images: Literal["first", "each other", "all"]
    kinds: list[Kind]
    render: list[str]
    bodies: list[BodyPlan]
    level: Level
    similarity: Similarity
    optimiser: Optimiser
    prior: Prior | None = None
    weights: list[Weighting] = field(default_factory=list)
    imaging: Imaging = PLAIN

    def __post_init__(self) -> None:
        for word, images in ((VIEW, "each other"), (VIEWS, "all")):
            if self.images != images and any(body.move == [word] for body in self.bodies):
                raise InputError(f"`move: [{word}]` needs `images: {images}`.")

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`."""
        if reason := lacking(chosen_kinds(self.kinds, scene), scene):
            return reason
        named = (body.names(scene, poses) for body in self.bodies)
        check_placed({*chosen_objects(self.render, poses)}.union(*named), poses)
        if scene.views == 1 and (self.images == "each other" or self._moves_only_the_carm):
            return ONE_VIEW
        if scene.camera_from_camera1 is not None and self._moves_only_the_carm:
            return CARM_IS_KNOWN
        return None

    def run(self, scene: Scene, poses: Poses, seed: int) -> Iterator[StageRecord]:
        """The optimisation, or one for each other view from the poses after the one before, see `Step`."""
        others = range(1, scene.views)
        if self.images != "each other":
            yield run_stage(scene, poses, self, (0,) if self.images == "first" else (0, *others), seed)
            return
        for view in others:
            record = run_stage(scene, poses, self, (view,), seed)
            poses = record.poses
            yield record

    @property
    def _moves_only_the_carm(self) -> bool:
        return bool(self.bodies) and all(body.is_carm for body in self.bodies)


def run_stage(scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...], seed: int) -> StageRecord:
    """Optimise the bodies of one stage over the given views (from 0)."""
    began = time.perf_counter()
    kinds = chosen_kinds(stage.kinds, scene)
    render = chosen_objects(stage.render, poses)
    bodies = tuple(body for plan in stage.bodies for body in plan.bodies(scene, poses, kinds, views))
    images: list[tuple[Kind, int]] = [(kind, view) for kind in kinds for view in views]
    costs = image_costs(
        scene, poses, bodies, render, images, stage.level, stage.similarity, stage.weights, stage.imaging
    )
    objective = stage_objective(costs, bodies, stage.prior)
    result = stage.optimiser.minimise(objective, sum(len(body.free) for body in bodies), seed)
    seconds = time.perf_counter() - began
    turned = any(body.view for body in bodies)
    return StageRecord(
        stage.name,
        views[0] + 1 if stage.images == "each other" else None,
        result.value,
        result.evaluations,
        seconds,
        result.stop.value,
        moved(poses, bodies, result.delta),
        restarts_of(result, scene, bodies, lambda delta: moved(poses, bodies, delta)),
        moments_of(result, lambda delta: moved(poses, bodies, delta)),
        tuple(poses.camera1_from) if turned else tuple(name for body in bodies for name in body.objects),
    )
