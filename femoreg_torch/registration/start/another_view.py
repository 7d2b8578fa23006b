"""A start from another view, where view 1 shows too little for one of its own.

The bones are registered in the view that shows most landmarks that agree, and view 1 is looked for from there as the
others are from view 1 otherwise: by the first steps of the plan, with that view in the place of the first. All is told
in camera 1 nevertheless, as where a device is expected is.
"""

from dataclasses import replace
from typing import TypeVar

import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, StartRecord
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.registration.evidence.misfits import fits_like_view_1
from femoreg_torch.registration.orbit import OrbitSearch
from femoreg_torch.registration.plan import Plan
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.stage import Stage
from femoreg_torch.registration.start.by_network import start_in_view_1
from femoreg_torch.registration.start.find import Detector, look_at, with_segmentations
from femoreg_torch.registration.start.no_start import best_other_view, why_there_is_no_start
from femoreg_torch.registration.start.records import record_from_view, record_from_view_1
from femoreg_torch.registration.step import Step, chosen_kinds
from femoreg_torch.registration.workflow import run_plan

T = TypeVar("T")


def start_from_a_view(
    case: Case, scene: Scene, plan: Plan, detection: Detection, find: Detector, seed: int
) -> StartRecord:
    """The start in view 1 by what the network sees there (`detection`), or from another view that shows more.

    Another view is asked where view 1 has no start or one of few landmarks; in the latter case it is taken if the
    outlines of the bones agree better there. Raises `InputError` as `start_by_detection` does, if no other view has a
    start or view 1 does not fit what is found from there.
    """
    refused, least = None, 0.0
    try:
        found = start_in_view_1(case, scene, detection)
        if not found.few:
            return record_from_view_1(case, scene, detection, found)
        least = found.overlap or 0.0
    except InputError as error:
        refused = error
    if (other := _from_another_view(case, scene, plan, find, seed, least)) is not None:
        return other
    if refused is not None:
        raise why_there_is_no_start(case, scene, refused, find) from refused
    return record_from_view_1(case, scene, detection, found)


def _from_another_view(
    case: Case, scene: Scene, plan: Plan, find: Detector, seed: int, least: float
) -> StartRecord | None:
    """The start from another view whose outlines agree by more than `least` (Dice), None if there is none."""
    best = best_other_view(case, scene, case.anatomy or HIP, find)
    if best is None:
        return None
    view, start = best
    if start.overlap is not None and start.overlap <= least:
        return None
    if scene.camera_from_camera1 is not None:
        camera1_from = torch.linalg.inv(scene.camera_from_camera1[view]) @ start.camera_from_ct
        return record_from_view(view, scene.anchor, camera1_from, start)
    there, steps = with_view_first(scene, view), _until_views_are_found(plan, scene)
    if not steps:
        return None
    if plan.needs_segmentations:
        there = with_segmentations(there, look_at(there, 0, find), find)
    poses = run_plan(there, replace(plan, steps=steps), start.camera_from_ct, seed).poses
    if not fits_like_view_1(there, poses, view=1, imaging=plan.imaging):
        return None
    return record_from_view(view, scene.anchor, poses.camera_from(scene.anchor)[1], start)


def with_view_first(scene: Scene, view: int) -> Scene:
    """The images of the first kind alone, those of a view (from 0) first, and then of the others in their order.

    They show nothing of what starts where camera 1 has it, as nobody knows where that is from the other view.
    """
    order = [view, *(other for other in range(scene.views) if other != view)]
    kind = scene.first_kind

    def ordered(of: dict[str, tuple[T, ...]]) -> dict[str, tuple[T, ...]]:
        return {kind: tuple(of[kind][n] for n in order)} if kind in of else {}

    return replace(
        scene,
        objects={
            name: thing
            if _starts_with_landmarks(scene, name)
            else replace(thing, shown_in=tuple(other for other in thing.shown_in if other != kind))
            for name, thing in scene.objects.items()
        },
        images=ordered(scene.images),
        fields=ordered(scene.fields),
        saturated=ordered(scene.saturated),
        segmentations=(),
        left_on_left=tuple(n for n, other in enumerate(order) if other in scene.left_on_left),
    )


def _starts_with_landmarks(scene: Scene, name: str) -> bool:
    """Whether landmarks put an object where it starts, or one that it starts beside."""
    start = scene.objects[name].start
    return start.camera1_from is None and (start.beside is None or _starts_with_landmarks(scene, start.beside))


def _until_views_are_found(plan: Plan, scene: Scene) -> tuple[Step, ...]:
    """The steps of a plan up to the last that looks at each other view by itself.

    None if there is no such step, or if one looks at other images than the first kind, which shows the bones.
    """
    found = 0
    for number, step in enumerate(plan.steps, 1):
        if isinstance(step, OrbitSearch) or (isinstance(step, Stage) and step.images == "each other"):
            if scene.first_kind not in chosen_kinds(step.kinds, scene):
                return ()
            found = number
    return plan.steps[:found]
