"""A right registration leaves the guide on the plan, but for the robot's error; a doubtful one moves nothing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from coarse import PROCEDURE, SIMULATION, stores_in
from femoreg_torch.configs import load_preset
from torch import Tensor

from femoreg_torch.case import Result, read_case
from femoreg_torch.case.quality import ObjectQuality
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.evaluation import path_miss, reference_points
from femoreg_torch.fluoro import read_image
from femoreg_torch.geometry import Poses, exp_so3, invert_rigid, rigid, rotation_angle, transform_points
from sim.study.closed_loop import ClosedLoop, run_rounds
from sim.study.conditions import Body, Condition
from sim.study.record import Record

TRUSTED = ObjectQuality((), 0.0, (0.0, 0.0), (0.1,) * 3, (0.1,) * 3, None, True, "all views agree")
Register = Callable[[Path, dict[str, Tensor] | None], tuple[Record, Result | None]]
starts: list[dict[str, Tensor] | None] = []


def registered(change: Callable[[Poses], Poses] = lambda poses: poses, quality: ObjectQuality = TRUSTED) -> Register:
    """Tells the truth, or what `change` makes of it."""

    def register(folder: Path, start: dict[str, Tensor] | None) -> tuple[Record, Result | None]:
        starts.append(start)
        case = read_case(folder)
        assert case.truth is not None
        assert case.plan is not None
        poses = change(case.truth)
        points, directions = path_in_camera1(case, poses)
        told = dict.fromkeys(poses.camera1_from, quality)
        path = (case.plan.object, case.plan.tool)
        result = Result(poses, told, path=path, points_camera1=points, directions_camera1=directions)
        return {"refused": None, "trusted": result.verdict.trusted, "reasons": list(result.verdict.reasons)}, result

    return register


def run(root: Path, name: str, loop: ClosedLoop, register: Register) -> list[dict[str, Any]]:
    starts.clear()
    base = load_preset("simulation", root / SIMULATION)
    body = Body(PROCEDURE, stores_in(root), root / "loop_body")
    record = run_rounds(loop, Condition("plain"), PROCEDURE, base, body, root / "loop" / name, register)
    rounds: list[dict[str, Any]] = record["rounds"]
    return rounds


def test_the_truth_and_an_exact_robot_bring_the_guide_onto_the_plan(coarse_root: Path) -> None:
    first, second = run(coarse_root, "exact", ClosedLoop(2, 0.0, 0.0), registered())
    assert first["before_mm"] > 50  # the device starts in front of the patient
    assert first["left_mm"] == pytest.approx(0, abs=1e-6)
    assert first["left_deg"] == pytest.approx(0, abs=1e-4)
    assert (first["round"], second["round"]) == (1, 2)
    assert second["before_mm"] == pytest.approx(0, abs=1e-5)  # as the files of the second round tell it

    one, two = (read_case(coarse_root / "loop" / "exact" / f"round{number}") for number in (1, 2))
    assert one.truth is not None
    assert two.truth is not None
    # the patient lies still: the hip is turned as before, and the C-arm has moved by some centimetres, hardly turned
    turn, again = (
        invert_rigid(case.truth.camera1_from["pelvis"]) @ case.truth.camera1_from["femur"]
        for case in (one, two)
        if case.truth
    )
    torch.testing.assert_close(turn, again, atol=1e-6, rtol=0)
    moved = two.truth.camera1_from["pelvis"] @ invert_rigid(one.truth.camera1_from["pelvis"])
    assert 0 < torch.rad2deg(rotation_angle(moved[:3, :3])).item() < 3
    assert not torch.allclose(one.truth.camera_from_camera1[1], two.truth.camera_from_camera1[1], atol=1e-3)
    # what is told of the second round is where it is, but for the stop of the C-arm
    start = starts[1]
    assert starts[0] is None
    assert start is not None
    for name, pose in two.truth.camera1_from.items():
        off = pose @ invert_rigid(start[name])
        assert torch.rad2deg(rotation_angle(off[:3, :3])).item() < 1.01
    nominal = two.objects["device"].start.camera1_from
    assert nominal is not None
    torch.testing.assert_close(nominal, start["device"], atol=1e-6, rtol=0)


def test_the_device_is_seen_at_the_bone(coarse_root: Path) -> None:
    case = read_case(coarse_root / "loop" / "exact" / "round2")
    assert case.truth is not None
    points = case.objects["device"].points
    for view, images in enumerate(case.views):
        with_it, without = (read_image(images.images[kind]).float() for kind in ("device", "anatomy"))
        darker = (with_it < 0.5 * without).float()
        pose = case.truth.camera_from("device")[view]
        ends = transform_points(pose, torch.stack([points["base"], points["tip"]]))
        pixels = ends[:, :2] / ends[:, 2:] * case.carm.camera.sdd_mm / case.carm.camera.pixel_mm[0] + 47.5
        assert ((pixels > 0) & (pixels < 95)).all()
        column, row = pixels.mean(0).round().long().tolist()
        assert darker[row - 2 : row + 3, column - 2 : column + 3].max() == 1  # the middle of the guide


def test_a_robot_leaves_its_own_error_and_a_registration_its_own(coarse_root: Path) -> None:
    (only,) = run(coarse_root, "robot", ClosedLoop(1, 0.5, 1.0), registered())
    assert 0.1 < only["left_mm"] < 4
    assert 0 < only["left_deg"] < 2
    again = run(coarse_root, "again", ClosedLoop(1, 0.5, 1.0), registered())
    assert again[0]["left_mm"] == only["left_mm"]

    def shifted(poses: Poses) -> Poses:
        device = poses.camera1_from["device"].clone()
        device[:3, 3] += torch.tensor([0.0, 3.0, 4.0], dtype=torch.float64)
        return poses.with_object("device", device)

    (off,) = run(coarse_root, "shifted", ClosedLoop(1, 0.0, 0.0), registered(shifted))
    assert off["left_mm"] == pytest.approx(5, abs=1e-5)
    assert off["left_deg"] == pytest.approx(0, abs=1e-4)


def test_an_exact_robot_leaves_the_miss_that_a_study_keeps(coarse_root: Path) -> None:
    """A tool that is taken to be turned by half a degree: what the loop measures is what `path_miss` tells."""

    def turned(poses: Poses) -> Poses:
        turn = rigid(exp_so3(torch.tensor([0.005, -0.006, 0.004], dtype=torch.float64)))
        return poses.with_object("device", poses.camera1_from["device"] @ turn)

    (off,) = run(coarse_root, "turned", ClosedLoop(1, 0.0, 0.0), registered(turned))
    case = read_case(coarse_root / "loop" / "turned" / "round1")
    assert case.truth is not None
    found = path_miss(case.truth, turned(case.truth), reference_points(case))
    assert found is not None
    assert found["mm"] > 0.5
    assert off["left_mm"] == pytest.approx(found["mm"], abs=1e-5)


def test_what_is_not_trusted_moves_no_robot(coarse_root: Path) -> None:
    doubtful = replace(TRUSTED, trusted=False, reason="the views disagree")
    (only,) = run(coarse_root, "doubtful", ClosedLoop(2, 0.0, 0.0), registered(quality=doubtful))
    assert only["left_mm"] == only["before_mm"] > 50
    assert only["trusted"] is False
    (refused,) = run(
        coarse_root,
        "refused",
        ClosedLoop(2, 0.0, 0.0),
        lambda *_: ({"refused": "dark", "trusted": False, "reasons": []}, None),
    )
    assert (refused["status"], refused["reason"]) == ("refused", "dark")
    assert np.isfinite(refused["left_mm"])
