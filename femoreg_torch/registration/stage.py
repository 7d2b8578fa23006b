"""A stage: one optimisation of bodies over images, or one for each other view."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.extensions import Group, guarded, is_built_in, name_of
from femoreg_torch.geometry import Poses
from femoreg_torch.optimize import Optimiser, Result, SmoothObjective, Stop
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.intrinsics import DISTANCE, POINTS, Intrinsics, doubted, refined
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.moments import moments_of
from femoreg_torch.registration.objective import Prior, image_quadratic, stage_objective
from femoreg_torch.registration.restarts import restarts_of
from femoreg_torch.registration.scene import Body, Kind, Moving, Scene, intrinsics_of, moved, reference_point_in_view
from femoreg_torch.registration.step import (
    ALL,
    CARM_IS_KNOWN,
    ONE_VIEW,
    check_known,
    chosen_kinds,
    chosen_objects,
    lacking,
    one_after_another,
)
from femoreg_torch.registration.weights import Weighting
from femoreg_torch.settings import check_within
from femoreg_torch.similarity import Similarity

EACH, VIEW, VIEWS, INTRINSICS = "each", "view", "views", "intrinsics"


@dataclass(frozen=True)
class BodyPlan:
    """A body to move: `move` names objects of the scene that move together, or the C-arm of a view.

    [all] are all objects together, [each] stands for one body per object that the stage's images show. [view] is the
    C-arm of the view at hand in a stage for each other view, [views] stands for one body per view but the first; both
    are left out where the C-arm's poses are given. `rotation_deg` and `translation_mm` are per axis of the camera (x
    along columns, y along rows, z depth): the standard deviation of random candidates for CMA-ES and
    Levenberg–Marquardt, the half-width of the box for BOBYQA. Zero freezes an axis. `centre` names the object whose
    reference point it turns about: by default its own, that of the first if several are named, and for [all], [view]
    and [views] that of the scene's anchor. Objects that no image of the case shows are passed over, and a body stays
    where it is in a stage whose images show nothing of it.
    [intrinsics] are the cameras themselves: the source distance of all views and the principal point of each, as far as
    the C-arm's file is uncertain of them. With `doubt` they move only where they were refined before, or where the
    images, all else settled, doubt the file by so many standard deviations (infinite: they are not asked): images that
    are drawn a little wrong feign a little other intrinsics, and a C-arm's file may be right. Where images doubt the
    principal points alone, the source distance stays.
    """

    move: list[str]
    rotation_deg: list[float] = field(default_factory=list)
    translation_mm: list[float] = field(default_factory=list)
    centre: str | None = None
    doubt: float | None = None

    def __post_init__(self) -> None:
        if self.is_intrinsics:
            if self.rotation_deg or self.translation_mm or self.centre is not None:
                raise InputError(
                    f"`move: [{INTRINSICS}]` takes `doubt` alone; the C-arm's file says how far they move."
                )
            return
        if self.doubt is not None:
            raise InputError(f"`doubt` is for `move: [{INTRINSICS}]` alone.")
        if len(self.rotation_deg) != 3 or len(self.translation_mm) != 3:
            raise InputError("rotation_deg and translation_mm need three numbers, one per camera axis.")
        if not self.move:
            raise InputError("a body: `move` names nothing.")
        if not any((*self.rotation_deg, *self.translation_mm)):
            raise InputError("a body: rotation_deg and translation_mm are all zero, so it does not move. Leave it out.")
        check_within(self, rotation_deg=(0, 180), translation_mm=(0, 5000))

    @property
    def is_carm(self) -> bool:
        """Whether it is the C-arm that moves."""
        return self.move in ([VIEW], [VIEWS])

    @property
    def is_intrinsics(self) -> bool:
        """Whether it stands for the cameras."""
        return self.move == [INTRINSICS]

    @property
    def names(self) -> set[str]:
        """The names of objects that it moves or turns about."""
        moving = () if self.is_carm or self.is_intrinsics or self.move == [EACH] else self.move
        return {*moving, *(() if self.centre is None else (self.centre,))}

    def bodies(
        self, scene: Scene, poses: Poses, kinds: list[Kind], views: tuple[int, ...], render: Sequence[str] = (ALL,)
    ) -> Sequence[Moving]:
        """What it stands for in those images of the given kinds and views (from 0) that there are, of drawn objects."""
        images = scene.there(kinds, views)
        if self.is_intrinsics:
            return [intrinsics_of(scene, poses, chosen_objects(render, poses))]
        scale = torch.tensor([*self.rotation_deg, *self.translation_mm], dtype=torch.float64)
        scale[:3] *= torch.pi / 180

        def body(names: list[str], view: int) -> Body:
            about = self._about(scene, poses, names)
            return Body(tuple(names), view, reference_point_in_view(scene, poses, about, view), scale)

        if self.is_carm:
            seen = {view for _, view in images} if scene.camera_from_camera1 is None else set()
            return [body([], view) for view in views if view and view in seen]
        moving = chosen_objects([ALL] if self.move == [EACH] else self.move, poses)
        together = [[name] for name in moving] if self.move == [EACH] else [moving]
        return [body(names, 0) for names in together if any(scene.shown(names, kind) for kind, _ in images)]

    def _about(self, scene: Scene, poses: Poses, moving: list[str]) -> str:
        """The object whose reference point a body turns about."""
        if self.centre in poses.camera1_from:
            return self.centre
        return moving[0] if moving and self.move != [ALL] else scene.anchor


@dataclass(frozen=True)
class Stage:
    """One optimisation. `images` says which views take part: the first, each other view by itself, or all together.

    Objects are named as in the scene; [all] in `render` or `kinds` stands for all. Of the images of these kinds, those
    that there are take part. `weights` says which pixels count, see `pixel_weights`; by default all do. `imaging` says
    what is drawn besides the objects; by default nothing.
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
        for word, images in ((VIEW, "each other"), (VIEWS, "all"), (INTRINSICS, "all")):
            if self.images != images and any(body.move == [word] for body in self.bodies):
                raise InputError(f"`move: [{word}]` needs `images: {images}`.")

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`."""
        kinds = chosen_kinds(self.kinds, scene)
        check_known({*self.render}.union(*(body.names for body in self.bodies)), kinds, scene, poses)
        if scene.views == 1 and (self.images == "each other" or self._moves_only_the_carm):
            return ONE_VIEW
        if scene.camera_from_camera1 is not None and self._moves_only_the_carm:
            return CARM_IS_KNOWN
        if reason := lacking(kinds, self._views(scene), scene):
            return reason
        if not any(self.moving(scene, poses, views) for views in self._parts(scene)):
            return "its images show nothing of what it moves"
        return None

    def run(self, scene: Scene, poses: Poses, seed: int) -> Iterator[StageRecord]:
        """The optimisation, or one for each other view from the poses after the one before, see `Step`.

        Where only C-arms move, views do not wait for one another.
        """
        parts = self._parts(scene)
        if len(parts) > 1 and self._moves_only_the_carm:
            there = [views for views in parts if self.moving(scene, poses, views)]
            records = on_all_cores(lambda views: run_stage(scene, poses, self, views, seed), there, scene.device)
            yield from one_after_another(records, [view for view, *_ in there])
            return
        for views in parts:
            if self.moving(scene, poses, views):
                record = run_stage(scene, poses, self, views, seed)
                poses = record.poses
                yield record

    def _views(self, scene: Scene) -> tuple[int, ...]:
        """The views (from 0) that take part."""
        every = tuple(range(scene.views))
        return {"first": every[:1], "each other": every[1:], "all": every}[self.images]

    def _parts(self, scene: Scene) -> list[tuple[int, ...]]:
        """The views of each optimisation: all at once, or one after another."""
        views = self._views(scene)
        return [(view,) for view in views] if self.images == "each other" else [views]

    def moving(self, scene: Scene, poses: Poses, views: tuple[int, ...]) -> tuple[Moving, ...]:
        """The bodies that its images of these views (from 0) show, and the cameras if any body is there."""
        kinds = chosen_kinds(self.kinds, scene)
        plans = [plan.bodies(scene, poses, kinds, views, self.render) for plan in self.bodies]
        found = tuple(body for bodies in plans for body in bodies)
        return found if any(isinstance(body, Body) for body in found) else ()

    @property
    def doubt(self) -> float | None:
        """How strongly the images must doubt the C-arm's file before its intrinsics move; None: they need not."""
        return next((plan.doubt for plan in self.bodies if plan.doubt is not None), None)

    @property
    def _moves_only_the_carm(self) -> bool:
        return bool(self.bodies) and all(body.is_carm for body in self.bodies)


def run_stage(scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...], seed: int) -> StageRecord:
    """Optimise the bodies of one stage over the given views (from 0).

    Where its intrinsics wait for a doubt, the images are asked once all else has settled; if they doubt the C-arm's
    file, the stage goes on from there with what they doubt free.
    """
    began = time.perf_counter()
    every = frozenset([DISTANCE, POINTS])
    free = every if stage.doubt is None else refined(poses.changes)
    record = _optimised(scene, poses, stage, views, seed, free)
    more = free if free == every else free | _doubted(scene, record.poses, stage, views)
    if more == free:
        return replace(record, seconds=time.perf_counter() - began)
    after = _optimised(scene, record.poses, stage, views, seed, more)
    later = tuple(replace(m, evaluations=m.evaluations + record.evaluations) for m in after.moments)
    return replace(
        after,
        evaluations=record.evaluations + after.evaluations,
        seconds=time.perf_counter() - began,
        restarts=record.restarts + after.restarts,
        moments=record.moments + later,
    )


def _optimised(
    scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...], seed: int, free: frozenset[str]
) -> StageRecord:
    """The optimisation with no intrinsics free but those, see `Intrinsics.only`."""
    began = time.perf_counter()
    moving = stage.moving(scene, poses, views)
    moving = tuple(body.only(free) if isinstance(body, Intrinsics) else body for body in moving)
    bodies = tuple(body for body in moving if isinstance(body, Body) or len(body.free))
    objective = stage_objective(_costs(scene, poses, stage, views, bodies), bodies, stage.prior)
    result = _minimised(stage.optimiser, objective, sum(len(body.free) for body in bodies), seed)
    rigid = [body for body in bodies if isinstance(body, Body)]
    turned = len(rigid) < len(bodies) or any(body.view for body in rigid)
    return StageRecord(
        stage.name,
        views[0] + 1 if stage.images == "each other" else None,
        result.value,
        result.evaluations,
        time.perf_counter() - began,
        result.stop.value,
        moved(poses, bodies, result.delta),
        restarts_of(result, scene, bodies, lambda delta: moved(poses, bodies, delta)),
        moments_of(result, lambda delta: moved(poses, bodies, delta)),
        tuple(poses.camera1_from) if turned else tuple(name for body in rigid for name in body.objects),
    )


def _minimised(optimiser: Optimiser, objective: SmoothObjective, unknowns: int, seed: int) -> Result:
    """What an optimiser finds. Raises `InputError` that names one of another package if what it gives is no result."""
    group: Group = "femoreg_torch.optimisers"
    result = guarded("optimiser", group, optimiser, lambda: optimiser.minimise(objective, unknowns, seed))
    if is_built_in(optimiser):
        return result
    name = name_of(group, optimiser)
    if not isinstance(result, Result):
        raise InputError(f"optimiser {name}: a Result was expected, got {type(result).__name__}.")
    if not isinstance(result.stop, Stop):
        raise InputError(
            f"optimiser {name}: a Stop was expected to say why it ended, got {type(result.stop).__name__}."
        )
    delta = result.delta
    if not isinstance(delta, Tensor) or delta.shape != (unknowns,) or not torch.isfinite(delta).all():
        raise InputError(f"optimiser {name}: a finite delta of shape ({unknowns},) was expected.")
    return replace(result, delta=delta.double())


def _costs(scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...], bodies: tuple[Moving, ...]) -> ImageCosts:
    render = chosen_objects(stage.render, poses)
    images = scene.there(chosen_kinds(stage.kinds, scene), views)
    return image_costs(
        scene, poses, bodies, render, images, stage.level, stage.similarity, stage.weights, stage.imaging
    )


def _doubted(scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...]) -> frozenset[str]:
    """What of the C-arm's file the stage's images doubt too much; nothing where it need not be asked."""
    assert stage.doubt is not None  # or all of it were free
    if stage.doubt == math.inf:
        return frozenset()
    bodies = stage.moving(scene, poses, views)
    intrinsics = next((body for body in bodies if isinstance(body, Intrinsics)), None)
    if intrinsics is None:
        return frozenset()
    costs = _costs(scene, poses, stage, views, bodies)
    return doubted(image_quadratic(costs, costs.still), intrinsics, stage.doubt)
