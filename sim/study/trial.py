"""One procedure of a study registered, and everything worth keeping of it as a record for a JSON file."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from femoreg_torch.case import Case, Result, read_case
from femoreg_torch.case.femoroplasty import PELVIS
from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors, reference_points
from femoreg_torch.files import plain
from femoreg_torch.geometry import Poses
from femoreg_torch.registration import Plan
from femoreg_torch.registration.run import register_scene
from femoreg_torch.registration.scene import Scene
from sim.study.detections import simulated_detector
from sim.study.procedures import Procedure, Study
from sim.study.summary import OBJECTS


def run_trial(folder: Path, procedure: Procedure, study: Study, plan: Plan, views: int | None = None) -> dict[str, Any]:
    """Register the case in `folder` from simulated detections; `views` uses only so many of its views.

    A registration that refuses its input (`InputError`) is a result too: `refused` then holds the reason, else None,
    and there are no `errors`.
    """
    case = read_case(folder)
    if case.truth is None:
        raise InputError(f"{folder}: has no truth, so there is nothing to measure errors against.")
    truth = case.truth
    if views is not None:
        truth = truth.first_views(views)
        case = replace(case, views=case.views[:views], truth=truth)
    find = simulated_detector(
        case.landmarks, truth.camera1_from[PELVIS], study.detections, procedure.seed, load_network()
    )
    record: dict[str, Any] = {**asdict(procedure), "kind": kind(procedure), "preset": plan.preset}
    try:
        result, scene = register_scene(case, None, plan, seed=procedure.number, find=find)
    except InputError as error:
        return record | {"refused": str(error), "trusted": False, "reasons": []}
    return plain(record | {"refused": None} | _measured(case, scene, truth, result))


def kind(procedure: Procedure) -> str:
    """`procedural` or `real`, after the bones."""
    return "procedural" if procedure.procedural else "real"


def _measured(case: Case, scene: Scene, truth: Poses, result: Result) -> dict[str, Any]:
    points = reference_points(case, scene)
    assert result.start is not None  # of a registration that has just run
    at_start = scene.start(result.start.camera1_from_object)
    poses = {"camera_from_pelvis": result.poses.camera_from(PELVIS)}
    poses |= {f"camera1_from_{name}": pose for name, pose in result.poses.camera1_from.items() if name != PELVIS}
    return {
        "errors": errors(truth, result.poses, points),
        "start_errors": {name: row for name, row in errors(truth, at_start, points).items() if name in OBJECTS},
        "asked": [name for name in truth.camera1_from if scene.there(scene.objects[name].shown_in, range(scene.views))],
        "landmarks_used": sum(mark.used for mark in result.start.landmarks.values()),
        "trusted": result.verdict.trusted,
        "reasons": list(result.verdict.reasons),
        "skipped": list(result.skipped),
        "quality": {name: asdict(value) for name, value in result.quality.items()},
        "poses": poses,
        "stages": [
            {key: getattr(stage, key) for key in ("name", "view", "evaluations", "seconds")} for stage in result.stages
        ],
        "timings_s": result.timings_s,
        "threads": torch.get_num_threads(),
    }
