"""The card of a report: uncertainty of the guide, the correction in words, and what is said when nothing is known."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from femoreg_torch.case import Case, ObjectQuality, Result, read_case, read_result
from femoreg_torch.evaluation.report.card import card
from femoreg_torch.evaluation.report.uncertainty import guide_uncertainty
from femoreg_torch.geometry import exp_so3, invert_rigid, transform_points

ROTATION_DEG, TRANSLATION_MM = (0.3, 0.05, 0.6), (0.1, 0.2, 0.9)
COVARIANCE = torch.diag(torch.tensor([0.2, 0.4, 0.3, 0.6, 0.1, 0.3]).double().square())  # mm, then degrees
COVARIANCE[0, 4] = COVARIANCE[4, 0] = 0.01
COVARIANCE[3, 5] = COVARIANCE[5, 3] = -0.08
ENTRY = torch.tensor([40.0, 0, -20], dtype=torch.float64)  # of the procedure, LPS


def quality(
    trusted: bool = True,
    turn: tuple[float, ...] = ROTATION_DEG,
    shift: tuple[float, ...] = TRANSLATION_MM,
) -> ObjectQuality:
    return ObjectQuality((), 0.1, (0.1, 0.1), turn, shift, None, trusted, "all views agree")


@pytest.fixture
def case(kept_procedure: tuple[Path, Path]) -> Case:
    return read_case(kept_procedure[0])


@pytest.fixture
def result(kept_procedure: tuple[Path, Path]) -> Result:
    """A run with the guide 20° off the path."""
    found = read_result(kept_procedure[1])
    unit = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return replace(
        found,
        quality={name: quality() for name in found.poses.camera1_from},
        points_camera1={
            "entry_point": torch.tensor([40.0, 20, 680], dtype=torch.float64),
            "tip": torch.tensor([45.0, 30, 560], dtype=torch.float64),
        },
        directions_camera1={"path": unit, "guide": exp_so3(torch.tensor([0.0, 0.35, 0.0]).double()) @ unit},
        path_covariance=COVARIANCE,
    )


def drawn_motions(count: int = 40_000) -> tuple[Tensor, Tensor]:
    """Random turns (N, 3, 3) and shifts (N, 3) of the device in the femur, by the covariance of the result."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(count, 6, generator=generator).double() @ torch.linalg.cholesky(COVARIANCE).T
    return exp_so3(drawn[:, 3:].deg2rad()), drawn[:, :3]


def test_the_tips_uncertainty_is_that_of_moved_points(result: Result) -> None:
    """Against the largest spread, along any direction, of tips that were really moved about the entry point."""
    turns, shifts = drawn_motions()
    femur_from_camera1 = result.poses.camera1_from["femur"][:3, :3].T
    lever = femur_from_camera1 @ (result.points_camera1["tip"] - result.points_camera1["entry_point"])
    spread = torch.linalg.eigvalsh(torch.cov((turns @ lever + shifts).T))[-1].sqrt()
    found = guide_uncertainty(result)
    assert found is not None
    assert found.tip_mm == pytest.approx(float(spread), rel=0.02)


def test_the_angles_uncertainty_is_no_less_than_that_of_turned_directions(result: Result) -> None:
    guide = result.poses.camera1_from["femur"][:3, :3].T @ result.directions_camera1["guide"]
    square = torch.linalg.svd(guide[None])[2][1:]  # two directions square to it
    tilts = (drawn_motions()[0] @ guide) @ square.T
    spread = torch.linalg.eigvalsh(torch.cov(tilts.T))[-1].sqrt().rad2deg()
    found = guide_uncertainty(result)
    assert found is not None
    assert found.angle_deg == pytest.approx(float(spread), rel=0.02)


def test_a_turn_about_the_guide_does_not_tilt_it(result: Result) -> None:
    along = result.poses.camera1_from["femur"][:3, :3].T @ result.directions_camera1["guide"]
    about = torch.block_diag(torch.zeros(3, 3).double(), 900 * along[:, None] * along)
    found = guide_uncertainty(replace(result, path_covariance=about))
    assert found is not None
    assert found.angle_deg < 1e-4


@pytest.mark.parametrize("covariance", [None, torch.full((6, 6), float("nan"), dtype=torch.float64)])
def test_what_is_not_told_is_unknown(case: Case, result: Result, covariance: Tensor | None) -> None:
    silent = replace(result, path_covariance=covariance)
    assert guide_uncertainty(silent) is None
    assert [number.uncertainty for number in card(case, silent).numbers] == ["uncertainty unknown"] * 2


def test_what_moves_both_objects_alike_is_not_told_of_the_tip(case: Case, result: Result) -> None:
    """A source distance that nobody knows leaves depths open by mm, and the tip's place in the femur all but known."""
    deep = quality(shift=(0.1, 0.1, 5.0))
    told = card(case, replace(result, quality=dict.fromkeys(result.quality, deep)))
    assert told.numbers == card(case, result).numbers


def test_of_a_round_device_nothing_is_told_along_its_own_axes(case: Case, result: Result) -> None:
    unturned = replace(result.quality["device"], turn_told=False)
    told = card(case, replace(result, quality={**result.quality, "device": unturned}))
    assert told.correction[:2] == card(case, result).correction[:2]
    assert len(told.correction) == 3
    assert "navigation.json is not trusted" in told.correction[2]


def test_the_correction_is_told_along_the_patients_axes(case: Case, result: Result) -> None:
    """The tip 10 mm left of, 5 mm in front of and 3 mm above the entry point: it has to go back by these."""
    pose = result.poses.camera1_from["femur"]
    tip = ENTRY + torch.tensor([10.0, -5.0, 3.0], dtype=torch.float64)
    points = transform_points(pose, torch.stack([ENTRY, tip]))
    placed = replace(result, points_camera1={"entry_point": points[0], "tip": points[1]})
    told = card(case, placed)
    assert told.numbers[0].value == "11.58 mm"  # √134
    assert told.numbers[1].value == "20.05°"  # 0.35
    assert "20.05°" in told.correction[0]
    assert (
        told.correction[1]
        == "Move the tip by 11.58 mm: 10.0 mm to the patient's right, 5.0 mm to the back, 3.0 mm to the feet."
    )
    own_axes = invert_rigid(result.poses.camera1_from["device"])[:3, :3] @ (points[0] - points[1])
    assert ", ".join(f"{mm + 0.0:.2f}" for mm in own_axes.tolist()) in told.correction[2]


def test_without_quality_nothing_is_trusted(case: Case, result: Result) -> None:
    told = card(case, replace(result, quality={}))
    assert not told.trusted
    assert told.headline == "Not trusted"
    assert told.reasons == ("The result does not say how good it is.",)
    assert told.next == ("Register again: this result does not say how good it is.",)


def test_what_is_not_trusted_is_not_to_be_steered_by(case: Case, result: Result) -> None:
    doubted = card(case, replace(result, doubts=("the images are mirrored",)))
    assert doubted.reasons == ("The images are mirrored.",)
    assert doubted.next[0] == "Do not steer by this result."
    trusted = card(case, result)
    assert trusted.trusted
    assert not any("Do not" in step for step in trusted.next)
    assert any("Correct the device" in step for step in trusted.next)


def test_at_the_plan_there_is_nothing_to_correct(case: Case, result: Result) -> None:
    entry, path = result.points_camera1["entry_point"], result.directions_camera1["path"]
    there = replace(
        result,
        points_camera1={"entry_point": entry, "tip": entry + 0.01},
        directions_camera1={"path": path, "guide": path},
    )
    assert any("nothing to correct" in step for step in card(case, there).next)


def test_without_a_device_it_says_what_is_missing(case: Case, result: Result) -> None:
    poses = {name: pose for name, pose in result.poses.camera1_from.items() if name != "device"}
    qualities = {name: value for name, value in result.quality.items() if name != "device"}
    told = card(case, replace(result, poses=replace(result.poses, camera1_from=poses), quality=qualities))
    assert told.trusted
    assert told.numbers == ()
    assert "no tool was registered" in told.without_numbers.lower()
    assert any("take images with it" in step for step in told.next)
    assert told.left_out == ("There are no lateral images.",)
