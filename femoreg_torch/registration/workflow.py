"""The registration workflow: start pose from landmarks, then the steps of a plan (paper, section II-B)."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import orbit_angles
from femoreg_torch.optimize import Result, minimise
from femoreg_torch.registration.moments import Moment, moments_of
from femoreg_torch.registration.objective import image_costs, stage_objective
from femoreg_torch.registration.plan import VIEW, VIEWS, BodyPlan, OrbitSearch, Plan, Stage
from femoreg_torch.registration.restarts import Restart, restarts_of
from femoreg_torch.registration.scene import Body, Kind, Poses, Scene, moved, reference_point_in_view
from femoreg_torch.similarity import grad_ncc

Report = Callable[[str, float], None]  # what is done, and the share of the plan behind it


@dataclass(frozen=True, eq=False)
class StepTrace:
    """What one step did: its name, the poses after it, and how its optimisations ran."""

    name: str
    view: int | None  # the view that a step for each other view was run on
    poses: Poses
    result: Result | None  # None for an exhaustive search
    value: float
    evaluations: int
    seconds: float
    moments: tuple[Moment, ...] = ()  # along the optimisation, for the replay
    restarts: tuple[Restart, ...] = ()  # where its other starts ended
    moving: tuple[str, ...] = ()  # the objects that it moved, all of them with a C-arm


@dataclass(frozen=True, eq=False)
class Outcome:
    """Poses at the end of a plan, and the trace of every step."""

    poses: Poses
    trace: tuple[StepTrace, ...]


def run_plan(scene: Scene, plan: Plan, camera1_from_ct: Tensor, seed: int, report: Report) -> Outcome:
    """Run all steps of a plan from a start pose (4, 4) of the CT in view 1 and the nominal poses of other objects.

    Steps that look at images of a kind that the scene lacks are left out. Raises `InputError` for a step that names an
    object which the scene lacks or no image holds.
    """
    poses = scene.start(camera1_from_ct)
    trace: list[StepTrace] = []
    steps = [step for step in plan.steps if all(kind in scene.images for kind in step.kinds)]
    if any(isinstance(step, OrbitSearch) for step in plan.steps if step not in steps):
        raise InputError(
            f"registration preset {plan.preset}: it finds the C-arm of the other views by the device, but not every "
            "view of this case has an image with it. Choose another preset."
        )
    _check_objects(plan.preset, steps, poses)
    for number, step in enumerate(steps):
        report(step.name, number / len(steps))
        for entry in _run_step(scene, poses, step, seed * 1000 + number):
            trace.append(entry)
            poses = entry.poses
    report("done", 1.0)
    return Outcome(poses, tuple(trace))


def _check_objects(preset: str, steps: Sequence[Stage | OrbitSearch], poses: Poses) -> None:
    for step in steps:
        for name in sorted(step.objects - set(poses.camera1_from)):
            raise InputError(
                f"registration preset {preset}, step “{step.name}”: the images of this case hold no object “{name}”; "
                f"there are: {', '.join(poses.camera1_from)}."
            )


def _run_step(scene: Scene, poses: Poses, step: Stage | OrbitSearch, seed: int) -> Iterator[StepTrace]:
    others = range(1, scene.views)
    if isinstance(step, OrbitSearch):
        for view in others:
            entry = search_orbit(scene, poses, step, view)
            poses = entry.poses
            yield entry
    elif step.images == "each other":
        for view in others:
            entry = run_stage(scene, poses, step, (view,), seed)
            poses = entry.poses
            yield entry
    elif others or any(body.move != [VIEWS] for body in step.bodies):  # of the only view, the C-arm stays
        yield run_stage(scene, poses, step, (0,) if step.images == "first" else (0, *others), seed)


def run_stage(scene: Scene, poses: Poses, stage: Stage, views: tuple[int, ...], seed: int) -> StepTrace:
    """Optimise the bodies of one stage over the given views."""
    began = time.perf_counter()
    bodies = tuple(body for plan in stage.bodies for body in _bodies(scene, poses, plan, views))
    images: list[tuple[Kind, int]] = [(kind, view) for kind in stage.kinds for view in views]
    costs = image_costs(scene, poses, bodies, stage.render, images, stage.level, stage.weights, stage.imaging)
    objective = stage_objective(costs, bodies, stage.prior)
    result = minimise(objective, sum(len(body.free) for body in bodies), stage.optimiser, seed)
    view = views[0] if stage.images == "each other" else None
    seconds = time.perf_counter() - began
    after = moved(poses, bodies, result.delta)
    moments = moments_of(result, lambda delta: moved(poses, bodies, delta))
    restarts = restarts_of(result, scene, bodies, lambda delta: moved(poses, bodies, delta))
    turned = any(body.view for body in bodies)
    moving = tuple(poses.camera1_from) if turned else tuple(name for body in bodies for name in body.objects)
    evaluations = result.evaluations
    return StepTrace(stage.name, view, after, result, result.value, evaluations, seconds, moments, restarts, moving)


def _bodies(scene: Scene, poses: Poses, plan: BodyPlan, views: tuple[int, ...]) -> list[Body]:
    """The bodies of one entry: objects, the C-arm of the view at hand, or those of all views but the first."""
    scale = torch.tensor([*plan.rotation_deg, *plan.translation_mm], dtype=torch.float64)
    scale[:3] *= torch.pi / 180
    if plan.move in ([VIEW], [VIEWS]):
        moving = views[:1] if plan.move == [VIEW] else [view for view in views if view]
        return [Body((), view, reference_point_in_view(scene, poses, plan.centre, view), scale) for view in moving]
    return [Body(tuple(plan.move), 0, reference_point_in_view(scene, poses, plan.centre, 0), scale)]


def search_orbit(scene: Scene, poses: Poses, search: OrbitSearch, view: int) -> StepTrace:
    """Place the C-arm of one view at the angle of its orbit, from view 1, that fits its image best."""
    began = time.perf_counter()
    orbit = scene.carm.orbit(orbit_angles(search.half_range_deg, search.step_deg))  # (N, 4, 4)
    drawn_names = scene.shown(search.render, search.kind)
    where = torch.stack([orbit @ poses.camera1_from[name] for name in drawn_names], 1)  # (N, O, 4, 4)
    camera = scene.carm.camera.downsampled(search.level.downsample)
    drawn = project([scene.objects[name].volume for name in drawn_names], where, camera, search.level.step_mm)
    fixed = downsample(scene.images[search.kind][view], search.level.downsample)
    values = grad_ncc(fixed, search.level.patch_radius)(drawn)
    best = int(values.argmin())
    after = poses.with_view(view, orbit[best])
    seconds = time.perf_counter() - began
    return StepTrace(search.name, view, after, None, float(values[best]), len(orbit), seconds)
