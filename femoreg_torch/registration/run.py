"""One case registered, from its folder to a `Result`."""

import itertools
import math
import platform
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy
import torch
from torch import Tensor

import femoreg_torch
from femoreg_torch.case import Case, Result, StartRecord
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.detect import detect, load_network
from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry import CArm, Poses, check_rigid, invert_rigid, rotation_angle
from femoreg_torch.registration.doubts.ask import doubts
from femoreg_torch.registration.doubts.device import notes_on_unseen_tips
from femoreg_torch.registration.kernels import load_kernels
from femoreg_torch.registration.plan import Plan, load_plan
from femoreg_torch.registration.prepare.nominal import check_starts
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.registration.quality import Limits, assess, assess_cameras, final_covariance, path_covariance
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.start.another_view import start_from_a_view
from femoreg_torch.registration.start.by_hand import start_by_landmarks
from femoreg_torch.registration.start.display_told import doubts_about_head_up, doubts_about_the_display
from femoreg_torch.registration.start.find import Detector, look_at, with_segmentations
from femoreg_torch.registration.turn_search import turned_from_where_told
from femoreg_torch.registration.workflow import Follow, Report, run_plan

_ONE_PLACE_DEG, _ONE_PLACE_MM = 2.0, 30.0  # of views and sources: so near, they tell next to nothing of depth


def versions() -> dict[str, str]:
    """Versions of what a result depends on, by name."""
    return {
        "femoreg_torch": femoreg_torch.__version__,
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }


def silent(step: str, share: float) -> None:
    """A report that tells nobody."""


def network_detector(case: Case, weights: Path | None = None, device: torch.device = CPU) -> Detector:
    """The landmark network of a weights file, or the shipped one, on a device.

    Raises `InputError` if it knows another body part.
    """
    network = load_network(weights, device)
    if case.anatomy is not None and case.anatomy.landmark_names != network.anatomy.landmark_names:
        raise InputError(
            f"{case.folder}/case.yaml, anatomy: the network knows landmarks of the {network.anatomy.name}, not those "
            f"of the {case.anatomy.name}. Give landmarks in the image (--landmarks), or a start pose (--start)."
        )
    return lambda image, camera: detect(network, image, camera)


def register(
    case: Case,
    plan: Plan | str | Path = "fast",
    *,
    seed: int = 0,
    find: Detector | None = None,
    landmarks: Mapping[str, Tensor] | None = None,
    start: Mapping[str, Tensor] | None = None,
    camera_from_camera1: Tensor | None = None,
    device: torch.device = CPU,
    report: Report = silent,
) -> Result:
    """Register a case by a plan, or by the preset or YAML file of that name.

    `start` has poses (4, 4) in camera 1 of objects by name, in place of how the case starts them. Objects that start
    from landmarks are placed by `landmarks`, pixels (2,) (column, row) in the first image by name, or by what `find`
    sees there, which is the shipped network if nothing is given. With `camera_from_camera1` (V, 4, 4) the C-arm's poses
    are known and stay. Where a stage weighs pixels by the bones, `find` looks at every view. Volumes and images lie,
    and are drawn and compared, on `device`.
    Raises `InputError` for input that does not fit.
    """
    scene = None
    if camera_from_camera1 is not None:
        cameras = camera_from_camera1.double()
        if cameras.shape != (len(case.views), 4, 4):
            raise InputError(
                f"camera_from_camera1: ({len(case.views)}, 4, 4) was expected for the case's views, got "
                f"{tuple(cameras.shape)}."
            )
        cameras = torch.stack(
            [check_rigid(pose, f"camera_from_camera1[{number}]") for number, pose in enumerate(cameras)]
        )
        if not torch.allclose(cameras[0], torch.eye(4, dtype=torch.float64), atol=1e-6):
            raise InputError(
                "camera_from_camera1[0]: the identity was expected, as camera 1 is the frame of all poses. Give "
                "every pose times the inverse of the first."
            )
        scene = replace(prepare_scene(case), camera_from_camera1=cameras)
    return register_scene(
        case, scene, plan, seed=seed, find=find, landmarks=landmarks, start=start, device=device, report=report
    )[0]


def register_scene(
    case: Case,
    scene: Scene | None,
    plan: Plan | str | Path,
    *,
    seed: int,
    find: Detector | None = None,
    landmarks: Mapping[str, Tensor] | None = None,
    start: Mapping[str, Tensor] | None = None,
    device: torch.device = CPU,
    report: Report = silent,
    follow: Follow | None = None,
) -> tuple[Result, Scene]:
    """As `register`, from the scene of the case if it is there already; returns that as well.

    `follow` is told the poses after every optimisation, and those at the start.
    """
    clock = {"began": time.perf_counter()}
    report("reading CT and images", 0.0)
    starts = {name: thing.start for name, thing in case.objects.items()}
    if scene is not None:
        starts = {name: thing.start for name, thing in scene.objects.items()}
    placed = [name for name, begin in starts.items() if begin.by_landmarks and name not in (start or {})]
    with ThreadPoolExecutor(max_workers=3) as beside:  # preset, network and kernels are read while the CT is
        network = kernels = reading = None
        if scene is None:
            reading = beside.submit(prepare_scene, case)
        if device.type == "cpu":
            kernels = beside.submit(load_kernels)
        plan = plan if isinstance(plan, Plan) else load_plan(plan)
        looks = plan.needs_segmentations or (bool(placed) and landmarks is None)
        if looks and find is None and case.anatomy is not None:
            network = beside.submit(network_detector, case, None, device)
    if reading is not None:
        scene = reading.result()
    assert scene is not None  # given, or read
    scene = scene.to(device)
    if kernels is not None:
        kernels.result()  # raises what went wrong there
    if start is not None:
        scene = _started_at(scene, start)
    clock["prepared"] = time.perf_counter()
    look = find if network is None else network.result()
    began, scene = _start(case, scene, plan, look, landmarks, seed, report)
    clock["started"] = time.perf_counter()
    anchor = began.camera1_from_object if scene.needs_landmarks else None
    if follow is not None:
        follow(scene.start(anchor))
    outcome = run_plan(scene, plan, anchor, seed, report, follow)
    clock["registered"] = time.perf_counter()
    told, scene = scene, outcome.scene
    covariance = final_covariance(scene, outcome.poses, plan.imaging)
    quality = assess(scene, outcome.poses, Limits(), plan.imaging, outcome.trace, covariance)
    against = (
        *turned_from_where_told(
            plan.steps,
            outcome.trace,
            {name: each.displacement and each.displacement[0] for name, each in quality.items()},
        ),
        *doubts(case, told, scene, outcome.poses, quality, covariance, plan.imaging, Limits()),
    )
    done = time.perf_counter()
    points, directions = path_in_camera1(case, outcome.poses)
    displays = [case.display_of(view) for view in range(len(case.views))]
    result = Result(
        poses=outcome.poses,
        quality=quality,
        cameras=assess_cameras(scene, outcome.poses, covariance, displays) if outcome.poses.changes else (),
        doubts=against,
        start=began,
        stages=tuple(outcome.trace),
        skipped=(
            *scene.missing,
            *outcome.skipped,
            *_unchecked(case, scene, began),
            *notes_on_unseen_tips(case, scene, outcome.poses),
            *notes_on_the_views(scene, outcome.poses),
            *notes_on_the_carm(case.carm, outcome.poses),
        ),
        path=None if case.plan is None else (case.plan.object, case.plan.tool),
        points_camera1=points,
        directions_camera1=directions,
        path_covariance=path_covariance(case, scene, outcome.poses, covariance, Limits()),
        timings_s={
            "reading": clock["prepared"] - clock["began"],
            "detection": clock["started"] - clock["prepared"],
            "registration": clock["registered"] - clock["started"],
            "quality": done - clock["registered"],
            "total": done - clock["began"],
        },
        preset=plan.preset,
        seed=seed,
        versions=versions(),
    )
    if not result.verdict.trusted and told.needs_landmarks:
        why = doubts_about_head_up(case.display_of(0), outcome.poses.camera1_from[scene.anchor])
        if landmarks is None and not why:
            assert look is not None  # it found the start
            report("asking how view 1 was taken", 1.0)
            why = doubts_about_the_display(case, told, plan, look, outcome.trace, seed)
        result = replace(result, doubts=(*why, *result.doubts))
    return result, scene


def _unchecked(case: Case, scene: Scene, start: StartRecord) -> tuple[str, ...]:
    """What was not asked of the start, in words."""
    if start.silhouette_overlap is not None or case.anatomy is None or not case.anatomy.outline:
        return ()
    told = "" if scene.outline is not None else ", as the label map does not tell them apart"
    return (f"the start ({start.source}) was not compared with the outlines of the bones{told}",)


def notes_on_the_views(scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Objects that one view alone shows, and views that were taken from one place, in words."""
    told = []
    for name, thing in scene.objects.items():
        views = {view for _, view in scene.there(thing.shown_in, range(scene.views))}
        if len(views) == 1:
            told.append(
                f"one view alone shows {name}: how far along the beam it lies is told by its size in the picture, and "
                "little else; whether it moved, or is of another size than it was told, was not asked"
            )
    for one, other in itertools.combinations(range(scene.views), 2):
        between = poses.camera_from_camera1[other] @ invert_rigid(poses.camera_from_camera1[one])
        deg, mm = math.degrees(float(rotation_angle(between[:3, :3]))), float(between[:3, 3].norm())
        if deg < _ONE_PLACE_DEG and mm < _ONE_PLACE_MM:
            told.append(
                f"views {one + 1} and {other + 1} were taken from one place ({deg:.1f}°, {mm:.0f} mm apart): they tell "
                "depth as one of them does. Is it the same view twice?"
            )
    return tuple(told)


def notes_on_the_carm(carm: CArm, poses: Poses) -> tuple[str, ...]:
    """Whether a refinement moved the source distance of the C-arm's file, in words."""
    factor = max((change.sdd_factor for change in poses.changes), key=lambda each: abs(each - 1), default=1.0)
    if factor == 1.0:
        return ()
    told = carm.camera.sdd_mm
    return (
        f"the images moved the source distance from the {told:.0f} mm of the C-arm's file to {factor * told:.0f} mm, "
        "and all objects with it in depth; where they lie beside each other hardly changes by that. If the C-arm was "
        "calibrated, tell its `uncertainty`",
    )


def _started_at(scene: Scene, start: Mapping[str, Tensor]) -> Scene:
    """The scene with objects at these poses (4, 4) at the start."""
    objects = dict(scene.objects)
    for name, pose in start.items():
        if name not in objects:
            raise InputError(
                f"start: there is no object {shortened(name)} in this case; there are: {', '.join(objects)}."
            )
        given = check_rigid(pose.double(), f"start, {name}")
        objects[name] = replace(objects[name], start=replace(objects[name].start, camera1_from=given))
    check_starts(objects, scene.carm.camera.sdd_mm, "start")
    return replace(scene, objects=objects)


def _start(
    case: Case,
    scene: Scene,
    plan: Plan,
    look: Detector | None,
    landmarks: Mapping[str, Tensor] | None,
    seed: int,
    report: Report,
) -> tuple[StartRecord, Scene]:
    """The pose that the objects are placed by, and the scene with what the network sees, if a stage asks for it."""
    seen = None
    if plan.needs_segmentations or (scene.needs_landmarks and landmarks is None):
        if look is None:
            raise InputError(
                f"{case.folder}/case.yaml: no network knows the landmarks of {scene.anchor}. Name an `anatomy`, or "
                "give the landmarks in the image (--landmarks) or a start pose (--start)."
            )
        report("finding landmarks", 0.0)
        seen = look_at(scene, 0, look)
    if not scene.needs_landmarks:
        began = StartRecord(scene.anchor, scene.start().camera1_from[scene.anchor], "poses that were given")
    elif landmarks is not None:
        began = start_by_landmarks(case, scene.anchor, landmarks)
    else:
        assert seen is not None  # looked at above
        assert look is not None
        began = start_from_a_view(case, scene, plan, seen, look, seed)
    if plan.needs_segmentations and seen is not None and look is not None:
        scene = with_segmentations(scene, seen, look)
    return began, scene
