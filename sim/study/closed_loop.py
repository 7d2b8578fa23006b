"""The closed loop: what a registration tells is carried out by a robot, imaged again, and registered again.

Between the rounds the patient lies still, the robot moves the device by the told correction and an error of its own,
and the C-arm is moved in its image plane until the device at the bone is in view; its stops are drawn anew. Then it is
known roughly where everything is, so that later rounds start from the round before instead of from landmarks. The
device is imaged as if there were no soft tissue in its place.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.case import Case, Result, Start, new_folder, read_case
from femoreg_torch.case.femoroplasty import DEVICE, FEMUR, PELVIS, with_device
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.files import plain
from femoreg_torch.geometry import Poses, about_point, exp_so3, rigid, transform_points
from femoreg_torch.navigation import guide
from femoreg_torch.settings import check_within, read_record
from sim.study.conditions import Body, Condition, image_views, make_case, simulation_of, write_told
from sim.study.procedures import Procedure
from sim.study.record import Record, outcome
from sim.theatre import procedure as theatre
from sim.theatre.case_folders import copied
from sim.theatre.preoperative_case import read_preoperative
from sim.theatre.settings import Simulation


@dataclass(frozen=True)
class ClosedLoop:
    """How often, and how well the robot moves."""

    rounds: int
    robot_deg: float  # standard deviation of the robot's own error: of a turn about each axis at the tip of the guide
    robot_mm: float  # and of a shift along each

    def __post_init__(self) -> None:
        check_within(self, rounds=(0, 100), robot_deg=(0, 180), robot_mm=(0, 500))


Register = Callable[[Path, dict[str, Tensor] | None], tuple[Record, Result | None]]  # of a case folder, start poses


def run_rounds(
    loop: ClosedLoop,
    condition: Condition,
    procedure: Procedure,
    base: dict[str, Any],
    body: Body,
    out: Path,
    register: Register,
) -> Record:
    """Image, register and correct, round by round; the cases are written to OUT/round1, OUT/round2, …

    The record holds `rounds`. Each tells, beside what `register` does, the true distance of the guide's tip from the
    entry point and the true angle between guide and path, `before_mm` and `before_deg` as imaged, `left_mm` and
    `left_deg` after its correction. A result that is refused or not trusted moves no robot, and is the last one.
    """
    generator = torch.Generator().manual_seed(procedure.seed ^ 0x5EED)  # other draws than those of the first images
    rounds: list[Record] = []
    drawn: theatre.Procedure | None = None
    moved: _Moved | None = None
    for number in range(1, loop.rounds + 1):
        folder = out / f"round{number}"
        began = time.perf_counter()
        if moved is None:
            drawn = make_case(condition, procedure, base, body, folder)
        else:
            _image_again(condition, procedure, base, body, folder, moved, generator)
            drawn = moved.drawn
        simulated = time.perf_counter() - began
        found, result = register(folder, None if moved is None else moved.start)
        case = read_case(folder)
        before = after = true_gap(case, drawn.truth)
        steered = result is not None and result.verdict.trusted and result.object_from_tool is not None
        if steered:
            assert result is not None
            moved = _move(loop, case, result, drawn, simulation_settings(condition, base), generator)
            after = true_gap(case, moved.before_imaging)
        gap = dict(zip(("before_mm", "before_deg", "left_mm", "left_deg"), (*before, *after), strict=True))
        times = found.get("timings_s", {}) | {"simulation": simulated}
        rounds.append(plain(found | outcome(found) | {"round": number, "timings_s": times} | gap))
        if not steered:
            break
    last = rounds[-1]
    return {key: last[key] for key in ("refused", "trusted", "reasons")} | {"rounds": rounds}


def simulation_settings(condition: Condition, base: dict[str, Any]) -> Simulation:
    """The settings that a condition makes of others."""
    return read_record(Simulation, simulation_of(condition, base), f"condition {condition.name}")


def true_gap(case: Case, poses: Poses) -> tuple[float, float]:
    """Distance in mm of the guide's tip from the entry point, and angle in degrees of the guide to the planned path."""
    points, directions = path_in_camera1(case, poses)
    a, b = directions["guide"], directions["path"]
    angle = torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).item()
    return (points["tip"] - points["entry_point"]).norm().item(), math.degrees(angle)


@dataclass(frozen=True, eq=False)
class _Moved:
    """Where everything is after the robot and the C-arm have moved."""

    before_imaging: Poses  # true, in the camera frames of the round before
    drawn: theatre.Procedure  # true, in those of the next round
    start: dict[str, Tensor]  # (4, 4): where the objects are expected in camera 1 of the next round


def _move(
    loop: ClosedLoop,
    case: Case,
    result: Result,
    drawn: theatre.Procedure,
    settings: Simulation,
    generator: torch.Generator,
) -> _Moved:
    correction = guide(result).correction
    turn = math.radians(loop.robot_deg) * torch.randn(3, generator=generator, dtype=torch.float64)
    shift = loop.robot_mm * torch.randn(3, generator=generator, dtype=torch.float64)
    tip = case.objects[DEVICE].points["tip"]
    error = about_point(rigid(exp_so3(turn), shift), tip)
    truth = drawn.truth.with_object(DEVICE, drawn.truth.camera1_from[DEVICE] @ correction @ error)

    expected = dict(result.poses.camera1_from) | {DEVICE: result.poses.camera1_from[DEVICE] @ correction}
    aim = _middle(case, expected)
    nearer = rigid(translation=torch.tensor([-aim[0], -aim[1], 0.0], dtype=torch.float64))
    stops = torch.stack([stop @ nearer for stop in theatre.draw_stops(case.carm, settings.acquisition, generator)])
    there = truth.camera1_from
    new = replace(
        drawn,
        camera_from_pelvis=stops @ there[PELVIS],
        camera1_from_femur=stops[0] @ there[FEMUR],
        camera_from_device=stops @ there[DEVICE],
        lps_moved=None,
    )
    return _Moved(truth, new, {name: nearer @ pose for name, pose in expected.items()})


def _middle(case: Case, camera1_from: dict[str, Tensor]) -> Tensor:
    """The point (3,) midway between the target of the path and the base of the guide, in camera 1."""
    assert case.plan is not None  # a simulated femoroplasty has one
    target = transform_points(camera1_from[FEMUR], case.plan.target[None])[0]
    base = transform_points(camera1_from[DEVICE], case.objects[DEVICE].points["base"][None])[0]
    return (target + base) / 2


def _image_again(
    condition: Condition,
    procedure: Procedure,
    base: dict[str, Any],
    body: Body,
    target: Path,
    moved: _Moved,
    generator: torch.Generator,
) -> None:
    """Write the case of a later round, whose device is nominally where the robot was sent."""
    settings = simulation_settings(condition, base)
    patient = body.patient()
    with new_folder(target) as folder:
        known = read_preoperative(patient, procedure.hip, body.device_seed, settings, folder / f"{DEVICE}.stl")
        known = copied(known, folder)
        device = replace(known.device, start=Start(camera1_from=moved.start[DEVICE]))
        known = replace(known, case=with_device(known.case, device), device=device)
        images = image_views(body, known, moved.drawn, settings, generator)
        write_told(folder, known, images, moved.drawn, condition.told, body.device_seed)
