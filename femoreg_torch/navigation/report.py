"""Guidance as the content of `navigation.json`, and in a few words for people."""

import math
from collections.abc import Collection
from typing import Any

from rich.markup import escape
from torch import Tensor

from femoreg_torch.case import Result
from femoreg_torch.geometry import invert_rigid, rotation_angle, transform_points
from femoreg_torch.navigation.guidance import guide, untold_turn
from femoreg_torch.navigation.robot import Robot

NAVIGATION_NAME = "navigation.json"
NOTICE = "Research software, not a medical device: its output must not guide the treatment of a patient."


def navigation_content(result: Result, robot: Robot | None) -> dict[str, Any]:
    """Everything that `navigation.json` holds, as tensors, mm; in the robot's base too if its calibration is there.

    Keys are named after the object with the planned path and its tool: `femur_from_device`, `in_femur`, `in_device`.
    Of a round tool no image tells the turn about its own axis, so that no direction in its frame, or in the robot's
    base, is known, and the content is not trusted. What is told in the frame of the object holds if the result is
    trusted.
    Raises `InputError` if no tool was registered.
    """
    found = guide(result)
    name, tool = found.object, found.tool
    reasons = list(result.verdict.reasons)
    if (untold := untold_turn(result, found)) is not None:
        reasons.append(untold)
    object_from_tool, correction = found.object_from_tool, found.correction
    content: dict[str, Any] = {
        "version": 1,
        "object": name,
        "tool": tool,
        "trusted": not reasons,
        "reasons": reasons,
        "turn_told": untold is None,
        "skipped": result.skipped,
        "notice": NOTICE,
        "tip_offset_mm": found.tip_offset.norm(),
        "angle_deg": found.angle_deg,
        "correction_deg": math.degrees(rotation_angle(correction[:3, :3]).item()),
        f"{name}_from_{tool}": object_from_tool,
        f"correction_in_{tool}": correction,
        f"in_{name}": {
            "entry_point": transform_points(object_from_tool, found.entry_point[None])[0],
            "tip": transform_points(object_from_tool, found.tip[None])[0],
            "tip_offset": object_from_tool[:3, :3] @ found.tip_offset,
            "path": object_from_tool[:3, :3] @ found.path,
            "guide": object_from_tool[:3, :3] @ found.guide,
        },
        f"in_{tool}": {
            "entry_point": found.entry_point,
            "tip": found.tip,
            "tip_offset": found.tip_offset,
            "path": found.path,
            "guide": found.guide,
        },
    }
    if robot is not None:
        base_from_tool = robot.base_from_tool
        content["in_base"] = {
            key: transform_points(base_from_tool, vector[None])[0]
            if key in ("entry_point", "tip")
            else base_from_tool[:3, :3] @ vector
            for key, vector in content[f"in_{tool}"].items()
        }
        correction_in_base = base_from_tool @ correction @ invert_rigid(base_from_tool)
        content[f"base_from_{tool}"] = base_from_tool
        content[f"base_from_{name}"] = base_from_tool @ invert_rigid(object_from_tool)
        content["correction_in_base"] = correction_in_base
        content[f"base_from_corrected_{tool}"] = base_from_tool @ correction
        if robot.base_from_flange is not None:
            content["base_from_flange"] = robot.base_from_flange
            content["base_from_corrected_flange"] = correction_in_base @ robot.base_from_flange
    return content


def summary(content: dict[str, Any], told: Collection[str] = ()) -> list[str]:
    """Lines for a terminal, with rich's markup, from what `navigation_content` gives; reasons in `told` stand above."""
    tool = content["tool"]
    lines = [
        f"Guide tip {float(content['tip_offset_mm']):.2f} mm from the entry point, guide {content['angle_deg']:.2f}° "
        "off the planned path.",
        f"Correction of the {tool}: turn by {content['correction_deg']:.2f}° about the tip, then move the tip by "
        f"{_vector(-content[f'in_{tool}']['tip_offset'])} mm ({tool} frame)"
        + (f", {_vector(-content['in_base']['tip_offset'])} mm (robot base)." if "in_base" in content else "."),
    ]
    if not content["trusted"]:
        reasons = escape("; ".join(reason for reason in content["reasons"] if reason not in told))
        by = (
            "the correction" if len(content["reasons"]) == 1 and not content["turn_told"] else "this, it is not trusted"
        )
        lines.insert(0, f"[bold red]Do not steer by {by}[/]{f': {reasons}' if reasons else ''}.")
    return lines


def _vector(vector: Tensor) -> str:
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in vector.tolist()) + ")"
