"""The registration workflow: from start poses through the steps of a plan (paper, section II-B)."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.errors import InputError
from femoreg_torch.extensions import Group, guarded, is_built_in, name_of
from femoreg_torch.geometry import Poses
from femoreg_torch.geometry.rigid import check_rigid
from femoreg_torch.registration.materials.calibration import Calibration
from femoreg_torch.registration.plan import Plan
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.step import Step

Report = Callable[[str, float], None]  # what is done, and the share of the plan behind it
Follow = Callable[[Poses], None]  # where everything is after each optimisation of a step


@dataclass(frozen=True, eq=False)
class Outcome:
    """Poses at the end of a plan, what every step did, and which were left out."""

    scene: Scene  # with what was estimated of the images
    poses: Poses
    trace: tuple[StageRecord, ...]
    skipped: tuple[str, ...]  # and devices that were not estimated: sentences for people


def run_plan(
    scene: Scene,
    plan: Plan,
    camera1_from_anchor: Tensor | None,
    seed: int,
    report: Report | None = None,
    follow: Follow | None = None,
) -> Outcome:
    """Run all steps of a plan from where landmarks put the scene's anchor, (4, 4), and where all else starts.

    `camera1_from_anchor` is None where nothing starts from landmarks. What starts beside another object is placed
    there anew as long as no step has moved it: a leg lies otherwise than in the CT, and the device with it.
    Steps that the scene has nothing to do for are left out, and told. Raises `InputError` for a step that cannot run
    and that others need, or that names an object which no image holds.
    """
    poses = scene.start(camera1_from_anchor)
    reasons = {number: _left_out(plan, number, scene, poses) for number in range(len(plan.steps))}
    numbers = [number for number, reason in reasons.items() if reason is None]
    trace: list[StageRecord] = []
    notes: list[str] = []
    waiting = {name: pose for name, pose in poses.camera1_from.items() if _is_placed_beside(scene, name)}
    for done, number in enumerate(numbers):
        step = plan.steps[number]
        waiting = _placed_anew(scene, poses, waiting)
        poses = replace(poses, camera1_from=poses.camera1_from | waiting)
        if report:
            report(step.name, done / len(numbers))
        if isinstance(step, Calibration):
            scene, record, left = step.calibrate(scene, poses)
            notes += left
            records: Iterable[StageRecord] = [record]
        else:
            records = _records(plan, step, scene, poses, seed * 1000 + number)
        for record in records:
            trace.append(record)
            poses = record.poses
            if follow:
                follow(poses)
    if report:
        report("done", 1.0)
    skipped = (f"stage “{plan.steps[n].name}” was left out: {reason}" for n, reason in reasons.items() if reason)
    return Outcome(scene, poses, tuple(trace), (*skipped, *notes))


def _records(plan: Plan, step: Step, scene: Scene, poses: Poses, seed: int) -> Iterable[StageRecord]:
    """What a step does. Raises `InputError` that names one of another package which leaves nothing to go on from."""
    if is_built_in(step):
        return step.run(scene, poses, seed)
    where = f"registration preset {plan.preset}, step “{step.name}”:"
    group: Group = "femoreg_torch.steps"
    records = guarded(f"{where} step", group, step, lambda: list(step.run(scene, poses, seed)))
    if not records or not all(isinstance(record, StageRecord) for record in records):
        raise InputError(
            f"{where} {name_of(group, step)} gave no record, or something else. The last one holds the poses."
        )
    for record in records:
        for view, camera in enumerate(record.poses.camera_from_camera1, 1):
            check_rigid(camera, f"{where} the pose of the C-arm in view {view}")
        for name, pose in record.poses.camera1_from.items():
            check_rigid(pose, f"{where} the pose of the {name}")
    return records


def _is_placed_beside(scene: Scene, name: str) -> bool:
    start = scene.objects[name].start
    return start.beside is not None and start.camera1_from is None


def _placed_anew(scene: Scene, poses: Poses, waiting: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Of objects that wait where they were put (4, 4), those that no step has moved, beside where others are now."""
    placed: dict[str, Tensor] = {}
    for name, pose in waiting.items():
        start = scene.objects[name].start
        if torch.equal(poses.camera1_from[name], pose):
            assert start.beside is not None  # or it would not wait
            placed[name] = (poses.camera1_from | placed)[start.beside] @ start.beside_from_object
    return placed


def _left_out(plan: Plan, number: int, scene: Scene, poses: Poses) -> str | None:
    step = plan.steps[number]
    try:
        return guarded("step", "femoreg_torch.steps", step, lambda: step.left_out(scene, poses))
    except InputError as error:
        raise InputError(f"registration preset {plan.preset}, step “{step.name}”: {error}") from error
