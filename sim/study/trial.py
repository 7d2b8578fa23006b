"""One procedure of a study registered, and everything worth keeping of it as a record for a JSON file."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from femoreg_torch.case import Case, Result
from femoreg_torch.case.femoroplasty import DEVICE, FEMUR, PELVIS
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import (
    ReferencePoints,
    errors,
    overlay_figure,
    path_displacements,
    path_miss,
    reference_points,
)
from femoreg_torch.evaluation.overlay import Picture
from femoreg_torch.files import plain, temporary_file
from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.registration import Plan
from femoreg_torch.registration.run import register_scene
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.start.find import Detector
from sim.study.procedures import Procedure

_STARTED = (PELVIS, FEMUR, DEVICE)  # objects whose errors at the start are kept
_OVERLAY_PX = 900  # width of a run's picture


def register_case(
    case: Case,
    plan: Plan,
    seed: int,
    find: Detector | None = None,
    start: Mapping[str, Tensor] | None = None,
    scene: Scene | None = None,
    overlay: Path | None = None,
) -> tuple[dict[str, Any], Result | None]:
    """Register a case, and tell what is worth keeping, with errors where it has a truth; and the result, if any.

    `find`, `start` and `scene` are as in `femoreg_torch.registration.run.register_scene`. A small picture of the images
    with the edges of what was found is written to `overlay`, if given, as JPEG.
    """
    try:
        result, scene = register_scene(case, scene, plan, seed=seed, find=find, start=start)
    except InputError as error:
        return {"refused": str(error), "trusted": False, "reasons": []}, None
    if overlay is not None:
        _write_overlay(overlay, overlay_figure(case, scene, result.poses))
    return plain({"refused": None} | _told(case, result) | _measured(case, scene, result)), result


def _write_overlay(path: Path, picture: Picture) -> None:
    """Write a picture (H, W, 3) as a small JPEG, whole or not at all."""
    height = round(picture.shape[0] * _OVERLAY_PX / picture.shape[1])
    small = cv2.resize(picture, (_OVERLAY_PX, height), interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_file(path) as part:
        part.write_bytes(jpeg.tobytes())


def check_views(views: int | None, there: int, where: str) -> None:
    """Raises `InputError` that starts with `where` for more views than there are, and for none."""
    if views is not None and not 1 <= views <= there:
        raise InputError(f"{where}: 1 to {there} views were expected, so many there are; found {views}.")


def first_views(case: Case, views: int | None) -> Case:
    """The case with only so many of its views; with all if None."""
    if views is None:
        return case
    truth = None if case.truth is None else case.truth.first_views(views)
    return replace(case, views=case.views[:views], truth=truth)


def kind(procedure: Procedure) -> str:
    """`procedural` or `real`, after the bones."""
    return "procedural" if procedure.procedural else "real"


def _measured(case: Case, scene: Scene, result: Result) -> dict[str, Any]:
    """Errors against the truth of a case; nothing where it has none."""
    truth = case.truth
    if truth is None:
        return {}
    points = reference_points(case, scene)
    assert result.start is not None  # of a registration that has just run
    at_start = scene.start(result.start.camera1_from_object)
    return {
        "errors": errors(truth, result.poses, points),
        "pelvis_at_head_mm": _pelvis_at_head(truth, result.poses, points),
        "displacements_mm": path_displacements(truth, result.poses, points),
        "miss": path_miss(truth, result.poses, points),
        "start_errors": {name: row for name, row in errors(truth, at_start, points).items() if name in _STARTED},
        "asked": _asked(truth, scene),
    }


def _pelvis_at_head(truth: Poses, estimate: Poses, points: ReferencePoints) -> float | None:
    """Displacement in mm of the pelvis at the femoral head, as in the paper's Figure 9; None where one is missing."""
    if not {PELVIS, FEMUR} <= truth.camera1_from.keys() & estimate.camera1_from.keys():
        return None
    head = points.objects[FEMUR][None]
    there, found = (transform_points(poses.camera1_from[PELVIS], head) for poses in (truth, estimate))
    return float((found - there).norm())


def _asked(truth: Poses, scene: Scene) -> list[str]:
    """The objects that the images show."""
    return [name for name in truth.camera1_from if scene.there(scene.objects[name].shown_in, range(scene.views))]


def _told(case: Case, result: Result) -> dict[str, Any]:
    """What a result says of itself."""
    assert result.start is not None
    others = {f"camera1_from_{name}": pose for name, pose in result.poses.camera1_from.items() if name != result.anchor}
    return {
        "landmarks_used": sum(mark.used for mark in result.start.landmarks.values()),
        "trusted": result.verdict.trusted,
        "reasons": list(result.verdict.reasons),
        "skipped": list(result.skipped),
        "source": case.display_of(0).source,
        "quality": {name: asdict(value) for name, value in result.quality.items()},
        "poses": {f"camera_from_{result.anchor}": result.poses.camera_from(result.anchor)} | others,
        "stages": [
            {key: getattr(stage, key) for key in ("name", "view", "evaluations", "seconds")} for stage in result.stages
        ],
        "timings_s": result.timings_s,
        "threads": torch.get_num_threads(),
    }
