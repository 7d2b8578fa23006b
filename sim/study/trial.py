"""One procedure of a study registered, and everything worth keeping of it as a record for a JSON file."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from femoreg_torch.case import Case, Truth, read_case
from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors, poses_of, reference_points
from femoreg_torch.files import plain
from femoreg_torch.registration import Plan
from femoreg_torch.registration.run import register_by_plan
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
    if views is not None:
        poses = case.truth.camera_from_pelvis[:views]
        case = replace(case, views=case.views[:views], truth=replace(case.truth, camera_from_pelvis=poses))
    assert case.truth is not None  # seen above
    find = simulated_detector(
        case.landmarks, case.truth.camera_from_pelvis[0], study.detections, procedure.seed, load_network()
    )
    record: dict[str, Any] = {**asdict(procedure), "kind": kind(procedure), "preset": plan.preset}
    try:
        result = register_by_plan(case, plan, procedure.number, find, lambda *_: None)
    except InputError as error:
        return record | {"refused": str(error), "trusted": False}
    return plain(record | {"refused": None} | _measured(case, case.truth, result))


def kind(procedure: Procedure) -> str:
    """`procedural` or `real`, after the bones."""
    return "procedural" if procedure.procedural else "real"


def _measured(case: Case, truth: Truth, result: dict[str, Any]) -> dict[str, Any]:
    points = reference_points(case)
    start = result["start"]["camera1_from_pelvis"]
    device = None if case.device is None else case.device.camera1_from_device
    at_start = Truth(start.expand_as(truth.camera_from_pelvis), start, device)
    return {
        "errors": errors(truth, poses_of(result), points),
        "start_errors": {name: row for name, row in errors(truth, at_start, points).items() if name in OBJECTS},
        "landmarks_used": sum(mark["used"] for mark in result["start"]["landmarks"].values()),
        "trusted": result["trusted"],
        "quality": result["quality"],
        "poses": {key: result.get(key) for key in ("camera_from_pelvis", "camera1_from_femur", "camera1_from_device")},
        "stages": [
            {key: stage[key] for key in ("name", "view", "evaluations", "seconds")} for stage in result["stages"]
        ],
        "timings_s": result["timings_s"],
        "threads": torch.get_num_threads(),
    }
