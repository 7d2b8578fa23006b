"""A registration as the content of `result.json`."""

import platform
from dataclasses import asdict
from typing import Any

import numpy
import torch
from torch import Tensor

import femoreg_torch
from femoreg_torch.case import Case
from femoreg_torch.geometry import invert_rigid, transform_points
from femoreg_torch.registration.moments import moments_content
from femoreg_torch.registration.quality import ObjectQuality
from femoreg_torch.registration.scene import Poses
from femoreg_torch.registration.workflow import Outcome


def result_content(
    case: Case,
    outcome: Outcome,
    quality: dict[str, ObjectQuality],
    start: dict[str, Any],
    timings_s: dict[str, float],
    preset: str,
    seed: int,
) -> dict[str, Any]:
    """Everything that `result.json` holds, errors against a truth excepted. Matrices are tensors, mm."""
    poses = outcome.poses
    content: dict[str, Any] = {
        "version": 1,
        "camera_from_pelvis": poses.camera_from("pelvis"),
        "camera1_from_femur": poses.camera1_from["femur"],
        "points_camera1": {"entry_point": _move(poses, "femur", case.entry_point)},
        "directions_camera1": {"path": _direction(poses, "femur", case.entry_point, case.target)},
    }
    if "device" in poses.camera1_from and case.device is not None:
        points = case.device.points
        content["camera1_from_device"] = poses.camera1_from["device"]
        content["femur_from_device"] = invert_rigid(poses.camera1_from["femur"]) @ poses.camera1_from["device"]
        content["points_camera1"]["tip"] = _move(poses, "device", points["tip"])
        content["directions_camera1"]["guide"] = _direction(poses, "device", points["base"], points["tip"])
    return content | {
        "quality": {name: asdict(value) for name, value in quality.items()},
        "trusted": all(value.trusted for value in quality.values()),
        "start": start,
        "stages": [
            {
                "name": entry.name,
                "view": None if entry.view is None else entry.view + 1,
                "cost": entry.value,
                "evaluations": entry.evaluations,
                "seconds": entry.seconds,
                "restarts": [asdict(restart) for restart in entry.restarts],
                "stop": entry.result.stop.value if entry.result else "all angles tried",
                "camera_from_camera1": entry.poses.camera_from_camera1,
                "camera1_from": entry.poses.camera1_from,
                "moments": moments_content(entry.moments),
            }
            for entry in outcome.trace
        ],
        "timings_s": timings_s,
        "preset": preset,
        "seed": seed,
        "versions": {
            "femoreg_torch": femoreg_torch.__version__,
            "torch": torch.__version__,
            "numpy": numpy.__version__,
            "python": platform.python_version(),
        },
    }


def _move(poses: Poses, name: str, point: Tensor) -> Tensor:
    return transform_points(poses.camera1_from[name], point[None])[0]


def _direction(poses: Poses, name: str, start: Tensor, end: Tensor) -> Tensor:
    """Unit vector (3,) in camera 1 from one point of an object to another."""
    vector = poses.camera1_from[name][:3, :3] @ (end - start)
    return vector / vector.norm()
