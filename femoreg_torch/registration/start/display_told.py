"""Was view 1 taken, and stored, as the case says? Asked where a result cannot be trusted, as it explains all else.

A source behind the patient that nobody told gives a mirror image of what is expected. Landmarks and outlines fit it
nearly as well, and what is found from there on is wild: another source distance, a leg that moved, a device that points
the other way. The bones by themselves tell it: registered in view 1 alone, they fit best as the picture was taken.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile

from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, StageRecord
from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.fluoro.display import Source
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.plan import Plan
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.stage import Stage
from femoreg_torch.registration.start.find import Detector, find_start, look_at, with_segmentations
from femoreg_torch.registration.step import Step, chosen_kinds
from femoreg_torch.registration.workflow import run_plan

# Of the mean patch Grad-NCC, after the stages of view 1. In five cases of two foreign simulators, with the source in
# front and behind, told and not, the right display fitted better than any other by 0.08 to 0.11. In one more, whose
# start was wrong (a pelvis 17° off), a wrong display did by 0.06.
_BETTER = 0.07
# Cosine of the angle between the way to the head and down the picture: inlet and outlet views tilt by 45° at most.
_HEAD_DOWN = 0.5
_FRONT_AND_BACK: tuple[Source, ...] = ("anterior", "posterior")  # views from a side start from the same side alone


def doubts_about_the_display(
    case: Case, told: Scene, plan: Plan, find: Detector, trace: Sequence[StageRecord], seed: int
) -> tuple[str, ...]:
    """In words, whether the bones fit view 1 better with the source on the other side, or the picture mirrored.

    `told` is the scene before the registration, whose `trace` says how well the bones fit view 1 as the case tells it.
    Nothing is asked of plans that search view 1 without derivatives, which takes minutes, or by images that show more
    than the bones.
    """
    display = case.display_of(0)
    steps = tuple(takewhile(lambda step: _quick_of_view_1(step, told), plan.steps))
    ended = [record.cost for record in trace if steps and record.name == steps[-1].name]
    if display.source not in _FRONT_AND_BACK or not ended:
        return ()
    others = [
        replace(display, source=source, mirrored=mirrored)
        for source in _FRONT_AND_BACK
        for mirrored in (False, True)
        if (source, mirrored) != (display.source, display.mirrored)
    ]
    shorter = replace(plan, steps=steps)
    costs = on_all_cores(lambda other: _cost(case, told, shorter, find, other, seed), others, told.device)
    best = min(range(len(others)), key=lambda n: costs[n])
    if costs[best] > ended[-1] - _BETTER:
        return ()
    stands = "in front of" if others[best].source == "anterior" else "behind"
    mirrored = ", its picture mirrored," if others[best].mirrored else ""
    return (
        f"view 1 fits better as one whose source stands {stands} the patient{mirrored} (similarity "
        f"{1 - costs[best]:.2f} against {1 - ended[-1]:.2f} as the case tells it), which may be what other doubts "
        "come from: check `display` of the views, and whether the CT is mirrored",
    )


def doubts_about_head_up(display: Display, camera1_from_ct: Tensor) -> tuple[str, ...]:
    """In words, whether the patient stands head down in view 1, at a pose (4, 4) of the CT's LPS, as it was told."""
    if float(camera1_from_ct[1, 2]) < _HEAD_DOWN:
        return ()
    turned = (display.turned_deg + 180) % 360
    return (
        f"in view 1 the patient stands head down: is its picture turned by {turned}°, and not by {display.turned_deg}° "
        "(`display`)? Nominal poses of a device, axes and sides are told for a picture that stands head up",
    )


def _quick_of_view_1(step: Step, scene: Scene) -> bool:
    if not (isinstance(step, Stage) and step.images == "first" and isinstance(step.optimiser, LevenbergMarquardt)):
        return False
    return chosen_kinds(step.kinds, scene) == [scene.first_kind]


def _cost(case: Case, told: Scene, plan: Plan, find: Detector, display: Display, seed: int) -> float:
    """The cost of the bones in view 1 after a plan's stages, were it taken and stored so; infinite without a start."""
    as_told, kind = case.display_of(0), told.first_kind
    camera = display.camera(as_told.stored_camera(told.carm.camera))
    image, field = told.image(kind, 0), told.field(kind, 0)
    image = display.to_camera(as_told.to_stored(image))
    field = None if field is None else display.to_camera(as_told.to_stored(field))
    alone = replace(
        told,
        carm=replace(told.carm, camera=camera),
        images={kind: (image,)},
        fields={kind: (field,)},
        saturated={},
        segmentations=(),
        camera_from_camera1=None if told.camera_from_camera1 is None else told.camera_from_camera1[:1],
        left_on_left=(0,) if display.left_on_left else (),
    )
    try:
        seen = look_at(alone, 0, find)
        if plan.needs_segmentations:
            alone = with_segmentations(alone, seen, find)
        start = find_start(
            case.landmarks,
            seen,
            image,
            camera,
            told.outline,
            case.anatomy or HIP,
            field,
            display.beam,
            among_views=True,
        )
    except InputError:
        return float("inf")
    return run_plan(alone, plan, start.camera_from_ct, seed).trace[-1].cost
