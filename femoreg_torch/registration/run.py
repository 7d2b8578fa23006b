"""One case registered, from its folder to the content of its result."""

import time
from pathlib import Path
from typing import Any

from femoreg_torch.case import Case
from femoreg_torch.detect import detect, load_network
from femoreg_torch.registration.plan import Plan, load_plan
from femoreg_torch.registration.prepare import prepare_scene
from femoreg_torch.registration.quality import Limits, assess
from femoreg_torch.registration.report import result_content
from femoreg_torch.registration.start import Detector, start_from_landmarks, with_segmentations
from femoreg_torch.registration.workflow import Report, run_plan


def register_case(case: Case, preset: str, seed: int, weights: Path | None, report: Report) -> dict[str, Any]:
    """Register a case; returns the content of its `result.json` but for the errors against a truth.

    `weights` are those of the landmark network, None for those shipped. Raises `InputError` for input that does not
    fit.
    """
    plan, network = load_plan(preset), load_network(weights)
    return register_by_plan(case, plan, seed, lambda image, camera: detect(network, image, camera), report)


def register_by_plan(case: Case, plan: Plan, seed: int, find: Detector, report: Report) -> dict[str, Any]:
    """The same by any plan, and from the landmarks that `find` sees in view 1.

    Where a stage weighs pixels by the bones, `find` looks at every view.
    """
    clock = {"began": time.perf_counter()}
    report("reading CT and images", 0.0)
    scene = prepare_scene(case)
    clock["prepared"] = time.perf_counter()
    report("finding landmarks", 0.0)
    seen = find(scene.images["anatomy"][0], scene.carm.camera)
    camera1_from_pelvis, start = start_from_landmarks(case, scene, seen)
    if plan.needs_segmentations:
        scene = with_segmentations(scene, seen, find)
    clock["started"] = time.perf_counter()
    outcome = run_plan(scene, plan, camera1_from_pelvis, seed, report)
    clock["registered"] = time.perf_counter()
    quality = assess(scene, outcome.poses, Limits(), plan.imaging, outcome.trace)
    done = time.perf_counter()
    timings = {
        "reading": clock["prepared"] - clock["began"],
        "detection": clock["started"] - clock["prepared"],
        "registration": clock["registered"] - clock["started"],
        "quality": done - clock["registered"],
        "total": done - clock["began"],
    }
    return result_content(case, outcome, quality, start, timings, plan.preset, seed)
