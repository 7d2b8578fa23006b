"""The registration workflow: from start poses through the steps of a plan (paper, section II-B)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.calibration import Calibration
from femoreg_torch.registration.plan import Plan
from femoreg_torch.registration.scene import Scene

Report = Callable[[str, float], None]  # what is done, and the share of the plan behind it
Follow = Callable[[Poses], None]  # where everything is after each optimisation of a step


@dataclass(frozen=True, eq=False)
class Outcome:
    """Poses at the end of a plan, what every step did, and which were left out."""

    scene: Scene  # with what was estimated of the images
    poses: Poses
    trace: tuple[StageRecord, ...]
    skipped: tuple[str, ...]  # sentences for people


def run_plan(
    scene: Scene,
    plan: Plan,
    camera1_from_anchor: Tensor | None,
    seed: int,
    report: Report | None = None,
    follow: Follow | None = None,
) -> Outcome:
    """Run all steps of a plan from where landmarks put the scene's anchor, (4, 4), and where all else starts.

    `camera1_from_anchor` is None where nothing starts from landmarks. Steps that the scene has nothing to do for are
    left out, and told. Raises `InputError` for a step that cannot run and that others need, or that names an object
    which no image holds.
    """
    poses = scene.start(camera1_from_anchor)
    reasons = {number: _left_out(plan, number, scene, poses) for number in range(len(plan.steps))}
    numbers = [number for number, reason in reasons.items() if reason is None]
    trace: list[StageRecord] = []
    for done, number in enumerate(numbers):
        step = plan.steps[number]
        if report:
            report(step.name, done / len(numbers))
        if isinstance(step, Calibration):
            scene, record = step.calibrate(scene, poses)
            records: Iterable[StageRecord] = [record]
        else:
            records = step.run(scene, poses, seed * 1000 + number)
        for record in records:
            trace.append(record)
            poses = record.poses
            if follow:
                follow(poses)
    if report:
        report("done", 1.0)
    skipped = (f"stage “{plan.steps[n].name}” was left out: {reason}" for n, reason in reasons.items() if reason)
    return Outcome(scene, poses, tuple(trace), tuple(skipped))


def _left_out(plan: Plan, number: int, scene: Scene, poses: Poses) -> str | None:
    step = plan.steps[number]
    try:
        return step.left_out(scene, poses)
    except InputError as error:
        raise InputError(f"registration preset {plan.preset}, step “{step.name}”: {error}") from error
