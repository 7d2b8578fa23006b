"""Equations 5 to 13 against numbers worked out by hand."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from femoreg_torch.case import Case, CaseObject, PlannedPath, Result, View
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import ReferencePoints, errors, path_displacements, path_miss, reference_points
from femoreg_torch.evaluation.errors import paper_from_camera
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera, CArm, Poses, exp_so3, invert_rigid, poses_by_object, rigid, transform_points
from femoreg_torch.navigation import guide


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


def shifted(pose, x=0.0, y=0.0, z=0.0):
    """The pose after a shift along the camera's axes, mm."""
    return rigid(translation=vector(x, y, z)) @ pose


POINTS = ReferencePoints(
    objects={"pelvis": vector(0, 10, 20), "femur": vector(90, 0, 0), "device": vector(0, 0, 50)},
    plan=PlannedPath("femur", entry_point=vector(90, 0, -50), target=vector(90, 0, 0), tool="device"),
    guide=(vector(0, 0, 0), vector(0, 0, 100)),
)


def without(poses, name):
    """The same poses but for one object."""
    return Poses(poses.camera_from_camera1, {n: pose for n, pose in poses.camera1_from.items() if n != name})


def seen_in_views(poses, camera_from_pelvis):
    """The same poses, with the C-arm where it sees the pelvis so."""
    others = {name: pose for name, pose in poses.camera1_from.items() if name != "pelvis"}
    return poses_by_object(camera_from_pelvis, "pelvis", others)


@pytest.fixture
def truth():
    pelvis = rigid(torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64), vector(-50, 20, 750))
    views = torch.stack(
        [pelvis, *(rigid(exp_so3(vector(0, a, 0)), vector(30 * a, 2, 5)) @ pelvis for a in (0.2, -0.3))]
    )
    femur = pelvis @ rigid(exp_so3(vector(0.1, 0, 0)))
    device = rigid(exp_so3(vector(0, 1.2, 0)), vector(0, 0, 560))
    return poses_by_object(views, "pelvis", {"femur": femur, "device": device})


def test_a_perfect_estimate_has_no_error(truth):
    found = errors(truth, truth, POINTS)
    poses, metrics = (
        ["pelvis", "femur", "device", "view2", "view3"],
        ["entry_point_mm", "tip_mm", "relative_mm", "path_deg", "guide_deg", "miss_mm", "miss_deg"],
    )
    assert set(found) == {*poses, *metrics}
    for value in found.values():
        numbers = (
            [value] if isinstance(value, float) else [value["mm"], value["deg"], *value["mm_xyz"], *value["deg_xyz"]]
        )
        assert max(map(abs, numbers)) < 1e-9


@pytest.mark.parametrize(
    ("camera_shift", "expected"), [((1, 0, 0), [0, 1, 0]), ((0, 1, 0), [-1, 0, 0]), ((0, 0, 1), [0, 0, 1])]
)
def test_shifts_along_the_camera_axes_land_in_lr_is_and_ap(truth, camera_shift, expected):
    """Camera x is patient left (LR), camera y is down, away from the head (−IS), camera z is depth (AP)."""
    estimate = truth.with_object("femur", shifted(truth.camera1_from["femur"], *camera_shift))
    found = errors(truth, estimate, POINTS)
    assert found["femur"]["mm"] == pytest.approx(1)
    assert found["femur"]["mm_xyz"] == pytest.approx(expected, abs=1e-9)
    assert found["femur"]["deg"] == pytest.approx(0, abs=1e-9)
    assert found["entry_point_mm"] == pytest.approx(1)
    assert found["relative_mm"] == pytest.approx(1)
    assert found["tip_mm"] == pytest.approx(0, abs=1e-9)


# camera 1 upright, by hand: its x, y and z (rows) in LPS; y runs to the feet, z away from the source
UPRIGHT = {
    "anterior": [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]],  # the patient's left is on the right
    "posterior": [[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]],  # the patient's left is on the left
    "right": [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]],  # the patient looks to the right
    "left": [[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]],  # the patient looks to the left
}


@pytest.mark.parametrize("source", UPRIGHT)
def test_is_lr_and_ap_are_the_patients_wherever_the_source_stands(source):
    """1 mm to the head, 2 to the left, 3 to the back, and 2° about the axis to the left, in the patient's own axes."""
    camera1_from_lps = rigid(torch.tensor(UPRIGHT[source], dtype=torch.float64), vector(0, 0, 700))
    truth = Poses(torch.eye(4, dtype=torch.float64)[None], dict.fromkeys(POINTS.objects, camera1_from_lps))
    points, head = replace(POINTS, source=source), POINTS.objects["femur"]
    moved = truth.with_object("femur", camera1_from_lps @ rigid(translation=vector(2, 3, 1)))
    assert errors(truth, moved, points)["femur"]["mm_xyz"] == pytest.approx([1, 2, 3])
    assert path_displacements(truth, moved, points)["entry_point"].tolist() == pytest.approx([1, 2, 3])
    turn = rigid(translation=head) @ rigid(exp_so3(vector(math.radians(2), 0, 0))) @ rigid(translation=-head)
    turned = errors(truth, truth.with_object("femur", camera1_from_lps @ turn), points)["femur"]
    assert turned["deg_xyz"] == pytest.approx([0, 2, 0], abs=1e-6)


def test_axes_before_a_source_in_front_are_exact():
    axes = paper_from_camera("anterior")
    assert torch.equal(axes, torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64))
    assert not torch.signbit(axes[axes == 0]).any()


def test_the_first_view_tells_where_the_source_stands(tmp_path):
    camera = Camera(1000.0, (0.5, 0.5), (8, 8), (3.5, 3.5))
    case = Case(tmp_path, CArm(camera, (0.0, 0.0, 600.0), (0.0, 1.0, 0.0)), {}, display=Display("posterior"))
    assert reference_points(case).source == "posterior"
    views = (View({}, display=Display("left", mirrored=True)), View({}))
    assert reference_points(replace(case, views=views)).source == "left"


def test_a_rotation_about_the_head_moves_the_entry_point_by_the_chord(truth):
    """2° in LPS about the left-right axis through the head: the entry point 50 mm below it moves by 2 · 50 · sin 1°."""
    head = POINTS.objects["femur"]
    turn = rigid(translation=head) @ rigid(exp_so3(vector(math.radians(2), 0, 0))) @ rigid(translation=-head)
    found = errors(truth, truth.with_object("femur", truth.camera1_from["femur"] @ turn), POINTS)
    assert found["femur"]["mm"] == pytest.approx(0, abs=1e-9)
    assert found["femur"]["deg"] == pytest.approx(2)
    assert found["femur"]["deg_xyz"] == pytest.approx([0, 2, 0], abs=1e-6)
    assert found["entry_point_mm"] == pytest.approx(100 * math.sin(math.radians(1)))
    assert found["path_deg"] == pytest.approx(2)


def test_a_turn_about_the_guide_leaves_tip_and_direction(truth):
    about_guide = rigid(exp_so3(vector(0, 0, math.radians(3))))
    found = errors(truth, truth.with_object("device", truth.camera1_from["device"] @ about_guide), POINTS)
    assert found["device"]["deg"] == pytest.approx(3)
    assert found["tip_mm"] == pytest.approx(0, abs=1e-9)
    assert found["guide_deg"] == pytest.approx(0, abs=1e-9)


def test_equal_shifts_of_femur_and_device_cancel_in_the_relative_error(truth):
    estimate = truth.with_object("femur", shifted(truth.camera1_from["femur"], z=2)).with_object(
        "device", shifted(truth.camera1_from["device"], z=2)
    )
    found = errors(truth, estimate, POINTS)
    assert (found["entry_point_mm"], found["tip_mm"]) == pytest.approx((2, 2))
    assert found["relative_mm"] == pytest.approx(0, abs=1e-9)


def test_opposite_shifts_add_up_in_the_relative_error(truth):
    estimate = truth.with_object("femur", shifted(truth.camera1_from["femur"], x=1)).with_object(
        "device", shifted(truth.camera1_from["device"], x=-1, y=1.5)
    )
    assert errors(truth, estimate, POINTS)["relative_mm"] == pytest.approx(2.5)


def test_a_pelvis_shift_in_view_2_is_an_error_of_that_view_only(truth):
    """A shift s in camera 2 moves the source of camera 2 by −s, turned into camera 1: the length stays."""
    views = truth.camera_from("pelvis").clone()
    views[1] = shifted(views[1], x=0.3, z=0.4)
    found = errors(truth, seen_in_views(truth, views), POINTS)
    assert found["view2"]["mm"] == pytest.approx(0.5)
    assert found["view2"]["deg"] == pytest.approx(0, abs=1e-6)
    assert found["view3"]["mm"] == pytest.approx(0, abs=1e-9)
    assert found["pelvis"]["mm"] == pytest.approx(0, abs=1e-9)


def test_an_error_common_to_all_views_is_none_of_the_view_geometry(truth):
    wrong = rigid(exp_so3(vector(0.01, 0, 0.02)), vector(1, 2, 3))
    found = errors(truth, seen_in_views(truth, truth.camera_from("pelvis") @ wrong), POINTS)
    assert found["view2"]["mm"] == pytest.approx(0, abs=1e-9)
    assert found["pelvis"]["mm"] > 1


def test_lengths_and_angles_do_not_care_which_is_the_truth(truth):
    turn = rigid(exp_so3(vector(0.01, -0.02, 0.03)), vector(0.5, 0.2, -0.7))
    estimate = truth.with_object("femur", truth.camera1_from["femur"] @ turn).with_object(
        "device", truth.camera1_from["device"] @ turn
    )
    one, other = errors(truth, estimate, POINTS), errors(estimate, truth, POINTS)
    for key in ("entry_point_mm", "tip_mm", "relative_mm", "path_deg", "guide_deg"):
        assert one[key] == pytest.approx(other[key])
    assert one["femur"]["mm_xyz"] == pytest.approx([-v for v in other["femur"]["mm_xyz"]])
    assert one["femur"]["deg"] == pytest.approx(other["femur"]["deg"])


def test_without_a_device_only_bone_is_told(truth):
    found = errors(truth, without(truth, "device"), POINTS)
    assert "device" not in found
    assert "relative_mm" not in found
    assert "entry_point_mm" in found


def test_another_number_of_views_is_refused(truth):
    with pytest.raises(InputError, match="3 views"):
        errors(truth, truth.first_views(2), POINTS)


def test_a_truth_of_the_first_view_without_the_first_object_tells_of_the_rest(truth):
    """What beads in one image give: the same rows as the whole truth, but for the views and the pelvis."""
    estimate = truth.with_object("femur", shifted(truth.camera1_from["femur"], z=2.0))
    whole = errors(truth, estimate, POINTS)
    part = errors(without(truth, "pelvis").first_views(1), estimate, POINTS)
    assert part == {key: row for key, row in whole.items() if key not in ("pelvis", "view2", "view3")}
    assert part["relative_mm"] == pytest.approx(2.0)


def test_a_tool_that_is_turned_misses_by_its_way_to_the_bone(truth):
    """By hand: upright before the patient, tip 250 mm in front of the entry point, the tool taken to be turned by 0.2°.

    The turn is about the patient's left-right axis through the tip: where the tool was imaged, nothing is off. The
    estimate turns front (−P) to the feet (−S); carried 250 mm to the back, the true tool ends by 250 · sin 0.2° above
    the entry point, short by 250 · (1 − cos 0.2°), and turned by 0.2° the other way.
    """
    camera1_from_lps = rigid(torch.tensor(UPRIGHT["anterior"], dtype=torch.float64), vector(0, 0, 800))
    device = camera1_from_lps @ rigid(translation=POINTS.plan.entry_point + vector(0, -250, 0) - POINTS.guide[1])
    poses = dict.fromkeys(("pelvis", "femur"), camera1_from_lps) | {"device": device}
    truth = Poses(torch.eye(4, dtype=torch.float64)[None], poses)
    angle = math.radians(0.2)
    tip = POINTS.guide[1]
    turn = rigid(translation=tip) @ rigid(exp_so3(vector(angle, 0, 0))) @ rigid(translation=-tip)
    estimate = truth.with_object("device", device @ turn)
    assert errors(truth, estimate, POINTS)["relative_mm"] == pytest.approx(0, abs=1e-9)
    found = path_miss(truth, estimate, POINTS)
    assert errors(truth, estimate, POINTS)["miss_mm"] == found["mm"]
    assert found["mm"] == pytest.approx(2 * 250 * math.sin(angle / 2))
    assert found["mm_xyz"] == pytest.approx([-250 * math.sin(angle), 0, -250 * (1 - math.cos(angle))])
    assert found["deg_xyz"] == pytest.approx([0, -0.2, 0], abs=1e-9)


def test_a_miss_is_what_the_told_correction_leaves(truth):
    """Steered by `navigation` from wrong poses, carried out on the true tool, seen from the true femur."""
    case = Case(
        Path(), CArm(Camera(1000.0, (0.5, 0.5), (8, 8), (3.5, 3.5)), (0, 0, 600), (0, 1, 0)), {}, plan=POINTS.plan
    )
    base, tip = POINTS.guide
    case = replace(case, objects={"device": CaseObject("device", points={"base": base, "tip": tip})})
    wrong = [rigid(exp_so3(vector(0.01, -0.02, 0.015)), vector(0.5, -1, 2)), rigid(exp_so3(vector(-0.02, 0.01, 0)))]
    estimate = truth
    for name, motion in zip(("femur", "device"), wrong, strict=True):
        estimate = estimate.with_object(name, truth.camera1_from[name] @ motion)
    points, directions = path_in_camera1(case, estimate)
    result = Result(estimate, {}, path=("femur", "device"), points_camera1=points, directions_camera1=directions)
    steered = truth.camera1_from["device"] @ guide(result).correction
    found = path_miss(truth, estimate, POINTS)
    shift, turn = (vector(*found[key])[[1, 2, 0]] for key in ("mm_xyz", "deg_xyz"))
    motion = rigid(exp_so3(torch.deg2rad(turn)))
    entry, target = POINTS.plan.entry_point, POINTS.plan.target
    tip_in_femur = transform_points(invert_rigid(truth.camera1_from["femur"]) @ steered, tip[None])[0]
    torch.testing.assert_close(tip_in_femur, entry + shift, atol=1e-9, rtol=0)
    guide_in_femur = invert_rigid(truth.camera1_from["femur"])[:3, :3] @ steered[:3, :3] @ (tip - base)
    expected = motion[:3, :3] @ (target - entry)
    torch.testing.assert_close(guide_in_femur / guide_in_femur.norm(), expected / expected.norm(), atol=1e-9, rtol=0)
    assert found["mm"] > 5  # far more than where the tool was imaged


def test_without_a_plan_or_a_tool_nothing_misses(truth):
    assert path_miss(truth, truth, replace(POINTS, plan=None)) is None
    assert path_miss(truth, truth, replace(POINTS, plan=replace(POINTS.plan, tool=None))) is None
    assert path_miss(truth, without(truth, "device"), POINTS) is None
    assert path_miss(truth, truth, POINTS)["mm"] == pytest.approx(0, abs=1e-9)
