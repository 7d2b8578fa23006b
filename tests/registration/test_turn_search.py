"""A tool that is told any turn about its guide is found; one that is right stays, and what has no guide is left out."""

import re
from dataclasses import replace

import pytest
import torch
from registration_scenes import float64, make_scene, true_poses

from femoreg_torch.case import Start
from femoreg_torch.case.trace import StageRecord
from femoreg_torch.drr import project
from femoreg_torch.geometry import Poses, about_point, exp_se3, pose_difference, transform_points
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import Level, Scene, load_plan, turn_search
from femoreg_torch.registration.roundness import Axis
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.registration.turn_search import TurnSearch, turned_from_where_told
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()
BASE, TIP = float64(0, 0, 20), float64(0, 0, -20)
SEARCH = TurnSearch("turn", ["device"], ["probe"], ["probe"], 5.0, Level(3.0, 1.0), GradNcc(4))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A round guide with a light handle to one side, alone in three images."""
    whole = make_scene(TRUTH)
    z, y, x = torch.meshgrid(*[torch.arange(n).double() for n in (120, 61, 61)], indexing="ij")
    x, y, z = x - 30, y - 30, z - 20
    guide = (x.hypot(y) < 5) & (z.abs() < 20)
    handle = (x.abs() < 6) & (y > -4) & (y < 28) & (z > 30) & (z < 65)
    data = (0.2 * guide + 0.05 * handle).float()
    volume = Volume(data, axis_aligned((1.0, 1.0, 1.0), (-30, -30, -20)))
    pose = TRUTH.camera1_from["device"]
    poses = Poses(TRUTH.camera_from_camera1, {"probe": pose})
    images = tuple(
        project(volume, poses.camera_from("probe")[view][None], whole.camera(poses, view), 0.5)[0]
        for view in range(whole.views)
    )
    probe = RigidObject(volume, float64(0, 0, 0), ("device",), Start(pose), parts=(volume,), guide=(BASE, TIP))
    return replace(whole, objects={"probe": probe}, images={"device": images}, tissue=None, outline=None)


def turned(deg: float) -> Poses:
    """The probe turned about its guide, and 1 mm and 1° off besides."""
    pose = TRUTH.camera1_from["device"]
    base, tip = transform_points(pose, torch.stack([BASE, TIP]))
    axis = (tip - base) / (tip - base).norm()
    about_guide = about_point(exp_se3(torch.cat([axis * torch.pi / 180 * deg, float64(0, 0, 0)])[None]), base)[0]
    off = about_point(exp_se3(float64(0.01, -0.01, 0.01, 0.7, -0.5, 0.5)[None]), base)[0]
    return Poses(TRUTH.camera_from_camera1, {"probe": off @ about_guide @ pose})


def off(scene: Scene, poses: Poses) -> tuple[float, float]:
    """Degrees and mm from the truth."""
    point = scene.objects["probe"].reference_point
    return pose_difference(TRUTH.camera1_from["device"], poses.camera1_from["probe"], point)


@pytest.mark.parametrize("deg", [-137, -60, 90, 178])
def test_any_turn_is_found(scene: Scene, deg: float) -> None:
    (record,) = SEARCH.run(scene, turned(deg), seed=0)
    left_deg, mm = off(scene, record.poses)
    assert left_deg < 4  # a stage refines it
    assert mm < 1.5
    assert "fits better turned by" in record.stop
    assert record.moving == ("probe",)


@pytest.mark.parametrize("deg", [0, 4, 33])
def test_what_a_stage_finds_by_itself_is_not_called_another_turn(scene: Scene, deg: float) -> None:
    (record,) = SEARCH.run(scene, turned(deg), seed=0)
    assert off(scene, record.poses)[0] < 4
    assert "no other turn" in record.stop


def test_a_near_turn_is_found_where_a_stage_would_not_leave_its_place(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A descent of hardly a step stands for one that ends at a turn beside the right one."""
    monkeypatch.setattr(turn_search, "_OPTIMISER", LevenbergMarquardt(max_iterations=1))
    (record,) = SEARCH.run(scene, turned(-6), seed=0)
    assert re.search(r"fits better turned by [58]° about its guide", record.stop)
    assert off(scene, record.poses)[0] < 3


def test_steps_too_wide_for_near_turns_look_at_far_ones_alone(scene: Scene) -> None:
    (record,) = replace(SEARCH, step_deg=60.0).run(scene, turned(-60), seed=0)
    assert off(scene, record.poses)[0] < 4


def test_a_turn_that_is_right_stays_as_it_is(scene: Scene) -> None:
    right = Poses(TRUTH.camera_from_camera1, {"probe": TRUTH.camera1_from["device"]})
    (record,) = SEARCH.run(scene, right, seed=0)
    assert torch.equal(record.poses.camera1_from["probe"], right.camera1_from["probe"])


def test_a_turn_that_is_found_far_from_the_nominal_one_is_told(scene: Scene) -> None:
    """A mirrored model may fit as well as one that was turned round, so the nominal pose has to agree."""
    before = StageRecord("device, coarse", None, 0.5, 1, 0.1, "small step", turned(120), moving=("probe",))
    (far,) = SEARCH.run(scene, turned(120), seed=0)
    (near,) = SEARCH.run(scene, turned(3), seed=0)
    (doubt,) = turned_from_where_told([SEARCH], [before, far], {})
    assert "the probe was found turned by 1" in doubt
    assert turned_from_where_told([SEARCH], [replace(before, poses=turned(3)), near], {}) == ()
    assert turned_from_where_told([], [before, far], {}) == ()
    assert turned_from_where_told([SEARCH], [before, far], {"probe": 1.4}) == ()  # turned back, by the search
    assert len(turned_from_where_told([SEARCH], [before, far], {"probe": 170.0})) == 1


def test_what_has_no_guide_or_is_round_is_left_out(scene: Scene) -> None:
    probe = scene.objects["probe"]
    axis = Axis(BASE, float64(0, 0, 1))
    for other in (replace(probe, guide=None), replace(probe, axis=axis)):
        assert "guide" in (SEARCH.left_out(replace(scene, objects={"probe": other}), turned(0)) or "")
    assert SEARCH.left_out(scene, turned(0)) is None
    without = replace(scene, images={"anatomy": scene.images["device"]})
    assert "no image" in (SEARCH.left_out(without, turned(0)) or "")


def test_fast_searches_the_turn_before_materials_are_estimated() -> None:
    """An estimate of materials empties what lies elsewhere, and no turn fits better afterwards."""
    names = [step.name for step in load_plan("fast").steps]
    at = names.index("turn of the device about its guide")
    assert names[at - 1 : at + 2 : 2] == ["device in all views, coarse", "materials of the device"]
