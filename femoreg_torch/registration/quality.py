"""Can a registration be trusted? Asked of every object in every view, without knowing the truth.

Signs of a wrong pose are measured at the solution. First, what the image gains when the object is drawn: one
that is not where it is drawn explains little of the image. Second, where each view by itself would move the
object in its own image plane: views that pull in different directions contradict each other, or their common geometry.
Third, where all views together would move it beside the anchor, and the anchor itself, were everything free: what a
stage held in a wrong place, the C-arm, say, moves then. Fourth, the standard deviations of the pose
(`registration.evidence.covariance`), depth included. Neither asks a round model for its turn about its own axis
(`registration.roundness`). Fifth, how far it lies from where it was expected. Sixth, whether other starts of a stage
ended elsewhere and fitted as well. Seventh, how far what is not known of the C-arm's source distance and principal
points leaves it open beside the other objects; and of the C-arm itself, whether the images fit other intrinsics than
its file says. Eighth, of a device, whether the images tell its turn about its long axis and its guide
(`registration.evidence.turns`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.case.quality import CameraQuality, ObjectQuality, ViewQuality, largest
from femoreg_torch.case.trace import StageRecord
from femoreg_torch.cores import on_all_cores
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import CArm, Poses, pose_difference, transform_points
from femoreg_torch.optimize import parabola_minimum
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.evidence.covariance import PoseCovariance, pose_covariance
from femoreg_torch.registration.evidence.motion import JointTurn
from femoreg_torch.registration.evidence.turns import TOLD, losses_by_turning
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.roundness import Axis
from femoreg_torch.registration.scene import Body, Kind, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=1.55, step_mm=0.5)
_SIMILARITY = GradNcc(patch_radius=5)
_PROBE_MM = 0.6  # about half a pixel of the level, at the object
_NO_PEAK_MM = 50.0  # a step so far is that of a slope without a peak nearby
_LOWER = 5e-5  # of a similarity: less is none, as it is told


@dataclass(frozen=True)
class Limits:
    """Beyond these a registration is not trusted."""

    least_gain: float = 0.004  # of mean patch NCC, when the object is drawn
    most_pull_mm: float = 1.5  # of a single view in its image plane
    # Of all images together, were all that is registered free to move: of the anchor, and of other objects beside it.
    # In depth the anchor may be pulled farther. Images of other simulators pulled right results, off by 0.1 to 0.7 mm,
    # by 1.0 to 1.9 mm in depth, all objects together. A result that was 4 mm off in depth was pulled by more than 2 mm.
    most_common_pull_mm: float = 1.0
    most_common_pull_deg: float = 1.0
    most_common_depth_pull_mm: float = 2.0
    most_deviation_mm: float = 1.0  # standard deviation along any axis
    most_deviation_deg: float = 0.6  # and about any axis
    most_intrinsics_sigma: float = 3.0  # of the C-arm's file, between what it says and what the images fit
    # Half of `TOLD`, about the long axis and about the guide. Right turns lost 0.0044 to 0.0076 in three foreign cases,
    # 0.006 and more in 14 of two others, and were 0.2° off at most. Those that no image told lost 0.0004 at most, and
    # were up to 7° off; where one view showed a corner of a plastic handle alone, 0.0031, and the turn was 3.6° off.
    least_loss_by_turning: float = TOLD / 2
    # A start of a stage is a rival of the best one if it ended with a cost so little above that, and so far from it by
    # the turn or the place; what is nearer, the following stages tell apart.
    rival_cost: float = 0.005
    rival_deg: float = 15.0
    rival_mm: float = 50.0
    most_displacement_mm: float = (
        8.0  # from the place beside the object that it starts beside; joints do not gape so far
    )


def assess(
    scene: Scene,
    poses: Poses,
    limits: Limits,
    imaging: Imaging = PLAIN,
    trace: Sequence[StageRecord] = (),
    covariance: PoseCovariance | None = None,
) -> dict[str, ObjectQuality]:
    """Quality of every object placed in `poses`, drawn with `imaging`: in every view the first kind that shows it.

    A view that has no image which shows an object says nothing about it.
    `trace` is that of the steps which led there, `covariance` that of `final_covariance`, if it is known already.
    """
    covariance = covariance or final_covariance(scene, poses, imaging)
    images = [
        (name, seen[0])
        for name in poses.camera1_from
        for view in range(scene.views)
        if (seen := scene.there(scene.objects[name].shown_in, (view,)))
    ]
    found = on_all_cores(lambda each: _assess_view(scene, poses, *each, imaging), images, scene.device)
    by_name = {
        name: tuple(view for (of, _), view in zip(images, found, strict=True) if of == name)
        for name in poses.camera1_from
    }
    devices = [name for name in by_name if not scene.objects[name].classes and scene.objects[name].axis is None]
    lost = {name: losses_by_turning(scene, poses, name, _LEVEL, _SIMILARITY, imaging) for name in devices}
    return {
        name: _assess_object(scene, poses, name, views, covariance, limits, trace, lost.get(name))
        for name, views in by_name.items()
    }


def final_covariance(scene: Scene, poses: Poses, imaging: Imaging = PLAIN) -> PoseCovariance:
    """The covariance of a solution that its quality is told by."""
    return pose_covariance(scene, poses, _LEVEL, _SIMILARITY, imaging)


def finer_joint_turns(scene: Scene, poses: Poses, imaging: Imaging = PLAIN) -> tuple[JointTurn, ...]:
    """Turns of bones in their joints in single views, as pixels of half the size tell them: more surely."""
    finer = replace(_LEVEL, pixel_mm=_LEVEL.pixel_mm / 2)
    return pose_covariance(scene, poses, finer, _SIMILARITY, imaging).joint_turns


def assess_cameras(
    scene: Scene, poses: Poses, covariance: PoseCovariance, displays: Sequence[Display]
) -> tuple[CameraQuality, ...]:
    """The camera of every view as its pictures are stored (`displays`), and how well it is known."""
    deviation = covariance.intrinsics.deviation
    cameras = [display.stored_camera(scene.camera(poses, view)) for view, display in enumerate(displays)]
    shifts = [shift_px(scene.carm, display, deviation[1 + 2 * n : 3 + 2 * n]) for n, display in enumerate(displays)]
    return tuple(
        CameraQuality(
            camera.sdd_mm,
            camera.principal_point_px,
            float(deviation[0]) * scene.carm.assumed_uncertainty.sdd_percent / 100 * camera.sdd_mm,
            (abs(columns), abs(rows)),
        )
        for camera, (columns, rows) in zip(cameras, shifts, strict=True)
    )


def carm_in_question(scene: Scene, poses: Poses, covariance: PoseCovariance, limits: Limits) -> bool:
    """Whether the deviations of the poses hold what is not known of the C-arm's intrinsics.

    They do where its file says how uncertain it is, where the intrinsics were refined, and where the images doubt the
    file; nan counts as that. Otherwise the file is taken at its word, as most are right: what the images alone leave
    open is the right measure then, and that of a C-arm which nobody has calibrated ten times too large.
    """
    believed = float(covariance.intrinsics.mean.abs().max()) <= limits.most_intrinsics_sigma
    return scene.carm.uncertainty is not None or bool(poses.changes) or not believed


def path_covariance(
    case: Case, scene: Scene, poses: Poses, covariance: PoseCovariance, limits: Limits
) -> Tensor | None:
    """How uncertain the tool's place is in the object with the planned path, see `Result.path_covariance`.

    None without a planned path, where its tool was not registered, or where the images leave it open.
    """
    plan = case.plan
    if plan is None or plan.tool is None or not {plan.object, plan.tool} <= set(poses.camera1_from):
        return None
    pose = poses.camera1_from[plan.object]
    entry = transform_points(pose, plan.entry_point[None])[0]
    images_only = not carm_in_question(scene, poses, covariance, limits)
    turn = torch.block_diag(pose[:3, :3].T, pose[:3, :3].T)
    found = turn @ covariance.beside(plan.tool, plan.object, entry, images_only) @ turn.T
    return found if torch.isfinite(found).all() else None


def shift_px(carm: CArm, display: Display, shift: Tensor) -> tuple[float, float]:
    """A shift (2,) of the principal point, in units of the C-arm's uncertainty: columns and rows of stored pictures."""
    along = shift * carm.assumed_uncertainty.principal_point_mm
    x, y = (display.camera_from_stored[:2, :2].T @ along).tolist()
    rows_mm, columns_mm = display.stored_camera(carm.camera).pixel_mm
    return x / columns_mm, y / rows_mm


def _assess_object(
    scene: Scene,
    poses: Poses,
    name: str,
    views: Sequence[ViewQuality],
    covariance: PoseCovariance,
    limits: Limits,
    trace: Sequence[StageRecord],
    lost_by_turning: tuple[float, float] | None,
) -> ObjectQuality:
    pulls = torch.tensor([view.pull_mm for view in views], dtype=torch.float64)
    uncertainty = float(pulls.square().mean().sqrt())
    in_question = carm_in_question(scene, poses, covariance, limits)
    with_carm = covariance.deviations(name)
    rotation, translation = with_carm if in_question else covariance.by_images(name)
    pull = covariance.pull(name)
    axis = scene.objects[name].axis
    judged = _Judged.of(covariance, poses, name, axis, scene.anchor)
    displacement = _displacement(scene, poses, name)
    reason = (
        _reason(name, views, limits)
        or _unturned(name, lost_by_turning, limits)  # before what it may be the cause of
        or _unsettled(name, judged, limits)
        or _vague(name, judged.rotation, judged.translation, limits)
        or _loose(name, scene.anchor, covariance, limits)
        or _displaced(scene, name, displacement, limits)
        or _rivalled(name, trace, limits)
    )
    told = reason or ("all views agree" if len(views) == scene.views else "all views that show it agree")
    if reason is None and axis is not None:
        told += "; it is round, and no image tells its turn about its own axis"
    return ObjectQuality(
        tuple(views),
        uncertainty,
        (float(pull[:3].norm()), float(pull[3:].norm())),
        tuple(rotation),
        tuple(translation),
        displacement,
        reason is None,
        told,
        axis is None and _unturned(name, lost_by_turning, limits) is None,
        tuple(with_carm[0]),
        tuple(with_carm[1]),
    )


@dataclass(frozen=True)
class _Judged:
    """What is asked of an object's pose: all that moves it, but not the turn of a round one about its own axis."""

    rotation: Sequence[float]  # (3,) degrees, standard deviations by the images
    translation: Sequence[float]  # (3,) mm
    pull: Tensor  # (6,) degrees and mm, of all images together
    beside: str | None  # the object that it is pulled beside; None for the anchor

    @classmethod
    def of(cls, covariance: PoseCovariance, poses: Poses, name: str, axis: Axis | None, anchor: str) -> "_Judged":
        beside = anchor if name != anchor and anchor in covariance.bodies else None
        pull = covariance.pull(name) if beside is None else covariance.pull_beside(name, beside)
        if axis is None:
            return cls(*covariance.by_images(name), pull, beside)
        i = 6 * covariance.bodies.index(name)
        rest = axis.without_turn(poses.camera1_from[name], covariance.centre(name))
        sigma = (rest @ covariance.images[i : i + 6, i : i + 6] @ rest.T).diagonal().clamp_min(0).sqrt().tolist()
        return cls(sigma[:3], sigma[3:], rest @ pull, beside)


def _unturned(name: str, lost: tuple[float, float] | None, limits: Limits) -> str | None:
    """`lost` is what the images lose by turning the object about its long axis, and its guide.

    None where that is not asked; nan counts as nothing.
    """
    if lost is None:
        return None
    for loss, axis in zip(lost, ("long axis", "guide"), strict=True):
        if not loss >= limits.least_loss_by_turning:
            nearly = f"nearly as well (similarity {loss:.4f} lower)" if loss >= _LOWER else "as well"
            return (
                f"no image tells the turn of the {name} about its {axis}: turned by 20 or 180°, what the images show "
                f"of it fits {nearly}; let them show more of it"
            )
    return None


def _displacement(scene: Scene, poses: Poses, name: str) -> tuple[float, float] | None:
    """How far an object lies from its nominal pose, or from its place beside another object, wherever that is now."""
    start = scene.objects[name].start
    if start.beside in poses.camera1_from:
        expected = poses.camera1_from[start.beside] @ start.beside_from_object
    elif start.camera1_from is not None:
        expected = start.camera1_from
    else:
        return None
    return pose_difference(expected, poses.camera1_from[name], scene.objects[name].reference_point)


def _displaced(scene: Scene, name: str, displacement: tuple[float, float] | None, limits: Limits) -> str | None:
    start = scene.objects[name].start
    if displacement is None or start.nominal or displacement[1] <= limits.most_displacement_mm:
        return None  # how far from its nominal pose an object may lie, nobody knows
    return f"the {name} lies {displacement[1]:.1f} mm from its place beside the {start.beside}"


def _unsettled(name: str, judged: _Judged, limits: Limits) -> str | None:
    """A stage that held something in a wrong place leaves the images pulling; nan counts as that."""
    pull = judged.pull
    turn, whole, across = (float(part.norm()) for part in (pull[:3], pull[3:], pull[3:5]))
    if judged.beside is None:
        settled = across <= limits.most_common_pull_mm and whole <= limits.most_common_depth_pull_mm
        beside = ""
    else:
        settled = whole <= limits.most_common_pull_mm
        beside = f" beside the {judged.beside}"
    if turn <= limits.most_common_pull_deg and settled:
        return None
    return f"all images together would move the {name} by {turn:.1f}° and {whole:.1f} mm{beside}, were all else free"


def _vague(name: str, rotation: Sequence[float], translation: Sequence[float], limits: Limits) -> str | None:
    """What the images leave open; nan counts as open."""
    mm, degrees = largest(translation), largest(rotation)
    if not mm <= limits.most_deviation_mm:
        return f"the images fix the {name} to {mm:.1f} mm only (standard deviation along one axis)"
    if not degrees <= limits.most_deviation_deg:
        return f"the images fix the {name} to {degrees:.1f}° only (standard deviation about one axis)"
    return None


def _loose(name: str, anchor: str, covariance: PoseCovariance, limits: Limits) -> str | None:
    """What not knowing the C-arm leaves open between two objects; nan counts as open."""
    if anchor not in covariance.bodies:
        return None
    deviation = largest(covariance.relative_mm(name, anchor))
    if deviation <= limits.most_deviation_mm:
        return None
    return (
        f"the C-arm's source distance and principal points are not known well enough: they leave the {name} open by "
        f"{deviation:.1f} mm beside the {anchor} (standard deviation along one axis)"
    )


def _reason(name: str, views: Sequence[ViewQuality], limits: Limits) -> str | None:
    for view in views:
        x, y = view.pull_mm
        if not math.hypot(x, y) < _NO_PEAK_MM:  # nan too
            return f"view {view.view} does not hold the {name}: its similarity has no peak near the solution"
        if math.hypot(x, y) > limits.most_pull_mm:
            return f"view {view.view} would move the {name} by ({x:.1f}, {y:.1f}) mm in its image plane"
        if view.gain < limits.least_gain:
            return f"drawing the {name} in view {view.view} explains hardly more of the image (gain {view.gain:.4f})"
    return None


def _rivalled(name: str, trace: Sequence[StageRecord], limits: Limits) -> str | None:
    for step in trace:
        for end in step.restarts if name in step.moving else ():
            if end.cost < limits.rival_cost and (end.apart_deg > limits.rival_deg or end.apart_mm > limits.rival_mm):
                return (
                    f"in the stage “{step.name}” a pose {end.apart_deg:.0f}° and {end.apart_mm:.0f} mm away fitted "
                    f"nearly as well (cost {end.cost:.4f} higher)"
                )
    return None


def _assess_view(scene: Scene, poses: Poses, name: str, image: tuple[Kind, int], imaging: Imaging) -> ViewQuality:
    kind, view = image
    local = poses.seen_from(view)  # so that a delta acts along the axes of this view
    centre = reference_point_in_view(scene, local, name, view)
    scale = torch.tensor([0, 0, 0, _PROBE_MM, _PROBE_MM, 0], dtype=torch.float64)
    body = Body((name,), 0, centre, scale)
    drawn = scene.shown(poses.camera1_from, kind)
    probes = torch.tensor([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], dtype=torch.float64)
    drawing = image_costs(scene, local, (body,), drawn, [image], _LEVEL, _SIMILARITY, imaging=imaging)
    costs = drawing(probes)[:, 0].tolist()
    without = float(drawing.without_what_moves()[0])
    across = parabola_minimum(costs[1], costs[0], costs[2]) * _PROBE_MM
    down = parabola_minimum(costs[3], costs[0], costs[4]) * _PROBE_MM
    return ViewQuality(view + 1, 1 - costs[0], without - costs[0], (across, down))
