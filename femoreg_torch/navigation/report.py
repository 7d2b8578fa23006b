"""Guidance as the content of `navigation.json`, and in a few words for people."""

import math
from typing import Any

from rich.markup import escape
from torch import Tensor

from femoreg_torch.geometry import invert_rigid, rotation_angle, transform_points
from femoreg_torch.navigation.guidance import guide
from femoreg_torch.navigation.robot import Robot

NAVIGATION_NAME = "navigation.json"
NOTICE = "Research software, not a medical device: its output must not guide the treatment of a patient."


def navigation_content(result: dict[str, Any], robot: Robot | None) -> dict[str, Any]:
    """Everything that `navigation.json` holds, as tensors, mm; in the robot's base too if its calibration is there.

    `result` holds tensors as `read_result` gives them. Raises `InputError` if no device was registered.
    """
    found = guide(result)
    femur_from_device, correction = found.femur_from_device, found.correction
    doubts = doubts_of(result)
    content: dict[str, Any] = {
        "version": 1,
        "trusted": not doubts,
        "reasons": doubts,
        "notice": NOTICE,
        "tip_offset_mm": found.tip_offset.norm(),
        "angle_deg": found.angle_deg,
        "correction_deg": math.degrees(rotation_angle(correction[:3, :3]).item()),
        "femur_from_device": femur_from_device,
        "correction_in_device": correction,
        "in_femur": {
            "entry_point": transform_points(femur_from_device, found.entry_point[None])[0],
            "tip": transform_points(femur_from_device, found.tip[None])[0],
            "tip_offset": femur_from_device[:3, :3] @ found.tip_offset,
            "path": femur_from_device[:3, :3] @ found.path,
            "guide": femur_from_device[:3, :3] @ found.guide,
        },
        "in_device": {
            "entry_point": found.entry_point,
            "tip": found.tip,
            "tip_offset": found.tip_offset,
            "path": found.path,
            "guide": found.guide,
        },
    }
    if robot is not None:
        base_from_device = robot.base_from_device
        content["in_base"] = {
            name: transform_points(base_from_device, vector[None])[0]
            if name in ("entry_point", "tip")
            else base_from_device[:3, :3] @ vector
            for name, vector in content["in_device"].items()
        }
        correction_in_base = base_from_device @ correction @ invert_rigid(base_from_device)
        content["base_from_device"] = base_from_device
        content["base_from_femur"] = base_from_device @ invert_rigid(femur_from_device)
        content["correction_in_base"] = correction_in_base
        content["base_from_corrected_device"] = base_from_device @ correction
        if robot.base_from_flange is not None:
            content["base_from_flange"] = robot.base_from_flange
            content["base_from_corrected_flange"] = correction_in_base @ robot.base_from_flange
    return content


def doubts_of(result: dict[str, Any]) -> list[str]:
    """Why a result is not to be trusted, one sentence per object; none if it is."""
    doubts = [
        f"{name}: {value.get('reason', 'no reason given')}"
        for name, value in result.get("quality", {}).items()
        if value.get("trusted") is not True
    ]
    if not doubts and result.get("trusted") is not True:
        return ["the registration does not say that it can be trusted"]
    return doubts


def summary(content: dict[str, Any]) -> list[str]:
    """Lines for a terminal, with rich's markup, from what `navigation_content` gives."""
    lines = [
        f"Guide tip {float(content['tip_offset_mm']):.2f} mm from the entry point, guide {content['angle_deg']:.2f}° "
        "off the planned path.",
        f"Correction of the device: turn by {content['correction_deg']:.2f}° about the tip, then move the tip by "
        f"{_vector(-content['in_device']['tip_offset'])} mm (device frame)"
        + (f", {_vector(-content['in_base']['tip_offset'])} mm (robot base)." if "in_base" in content else "."),
    ]
    if not content["trusted"]:
        reasons = escape("; ".join(content["reasons"]))
        lines.insert(0, f"[bold red]Do not steer by this, it is not trusted[/]: {reasons}.")
    return lines


def _vector(vector: Tensor) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in vector.tolist()) + ")"
