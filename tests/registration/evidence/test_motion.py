"""Motion of the patient between images without and with the device: found, told, not seen where there is none."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.geometry import about_point, exp_se3
from femoreg_torch.registration.doubts.movement import doubts_about_guides, doubts_about_motion, explains_the_carm
from femoreg_torch.registration.evidence.covariance import pose_covariance
from femoreg_torch.registration.evidence.fitted_alone import gain_alone
from femoreg_torch.registration.evidence.motion import GuideDrift, JointTurn, MotionBetween
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.quality import Limits
from femoreg_torch.registration.roundness import Axis
from femoreg_torch.registration.scene import Scene
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
LIMITS = Limits(most_deviation_deg=90.0)  # coarse images fix a device to some degrees
_TURN, _SHIFT = (0.0, 0.0, 1.2), (1.4, -0.9, 0.0)  # in the image plane of the first view


def _scene(moving: tuple[str, ...], views: tuple[int, ...] = (0, 1, 2)) -> Scene:
    """Anatomy that has turned about the middle of the pelvis, in the device images of some views."""
    truth = true_poses()
    still, there = make_scene(truth), truth
    for name in moving:
        pivot = truth.camera1_from[name].inverse() @ truth.camera1_from[moving[0]][:, 3]
        there = there.with_object(name, off(truth.camera1_from[name], pivot[:3], _TURN, _SHIFT))
    other = make_scene(there, seed=1).images["device"]
    mixed = tuple(
        b if view in views else a for view, (a, b) in enumerate(zip(still.images["device"], other, strict=True))
    )
    return replace(still, images=still.images | {"device": mixed})


def _never(drift: MotionBetween) -> float:
    raise AssertionError(f"nothing here is worth a fit: {drift}")


def _alone(scene: Scene, drift: MotionBetween) -> float:
    return gain_alone(scene, true_poses(), drift, PLAIN)


def test_a_device_is_not_moved_along_the_beam_of_its_view() -> None:
    """Nearer to the source it would look larger and darker, which an unknown material asks for."""
    truth = true_poses()
    scene = make_scene(truth)
    for view in range(3):
        found = truth.camera_from("device")[view]
        beam = found[:3, 3] / found[:3, 3].norm()
        across = torch.linalg.cross(beam, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
        gains = []
        for way in (beam, across / across.norm()):
            moved = found.clone()
            moved[:3, 3] += 8 * way if way is beam else 3 * way
            back = torch.linalg.inv(truth.camera_from_camera1[view]) @ moved
            drift = MotionBetween("device", (view,), ("device",), torch.zeros(6), torch.zeros(6), 0.0)
            gains.append(gain_alone(scene, truth.with_object("device", back), drift, PLAIN))
        assert gains[0] < 0.5 * gains[1], view
        assert gains[1] > 0.05


def _motions(scene: Scene) -> tuple[tuple[MotionBetween, ...], tuple[str, ...]]:
    covariance = pose_covariance(scene, true_poses(), _LEVEL, GradNcc(1))
    return covariance.motions, doubts_about_motion(covariance, LIMITS, {}, _never, tuple)


def test_no_motion_is_told_where_nothing_moved() -> None:
    motions, told = _motions(_scene(()))
    assert len(motions) == 6  # both bones and each of them in all views, both in each
    assert told == ()
    assert max(found.sureness for found in motions) < 3
    assert motions[0].size[0] < 0.1
    assert motions[0].size[1] < 0.3


def test_a_patient_who_moved_is_told_with_the_motion() -> None:
    motions, told = _motions(_scene(("pelvis", "femur")))
    assert motions[0].objects == ("pelvis", "femur")
    expected = torch.tensor([*_TURN, *_SHIFT], dtype=torch.float64)
    seen = [2, 3, 4]  # what one view tells; depth and turns out of its plane are less certain
    torch.testing.assert_close(motions[0].motion[seen], expected[seen], atol=0.35, rtol=0)
    assert len(told) == 1
    assert "the patient or the C-arm has moved" in told[0]


def test_a_leg_that_moved_is_told_as_that() -> None:
    _, told = _motions(_scene(("femur",)))
    assert "femur lies" in told[0]
    assert "the femur has moved" in told[0]


def test_a_c_arm_that_did_not_come_back_is_told_with_its_view() -> None:
    _, told = _motions(_scene(("pelvis", "femur"), views=(1,)))
    assert "of view 2" in told[0]


def test_one_kind_of_images_tells_nothing_of_motion() -> None:
    scene = make_scene(true_poses(), with_device=False)
    poses = true_poses()
    alone = replace(poses, camera1_from={name: poses.camera1_from[name] for name in ("pelvis", "femur")})
    objects = {name: scene.objects[name] for name in ("pelvis", "femur")}
    covariance = pose_covariance(replace(scene, objects=objects), alone, _LEVEL, GradNcc(1))
    assert covariance.motions == ()
    assert doubts_about_motion(covariance, LIMITS, {}, _never, tuple) == ()


@pytest.mark.parametrize(
    ("views", "sigmas", "gain", "told"),
    [((0, 1, 2), 2.4, 0.006, 1), ((0, 1, 2), 1.6, 0.006, 0), ((1,), 2.4, 0.006, 0), ((0, 1, 2), 3.5, 0.0005, 0)],
)
def test_all_views_together_need_less_certainty(views: tuple[int, ...], sigmas: float, gain: float, told: int) -> None:
    """A leg that turned by 1.8°; one view by itself erred by up to 2.8 deviations where nothing had moved.

    What explains next to nothing has not moved.
    """
    motion = torch.tensor([0.0, 0.0, 1.8, 0.0, 0.0, 0.4], dtype=torch.float64)
    found = MotionBetween("device", views, ("femur",), motion, motion.abs() / sigmas + 1e-9, gain)
    covariance = replace(pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)), motions=(found,))
    assert len(doubts_about_motion(covariance, LIMITS, {}, _never, tuple)) == told


def test_a_device_that_moved_between_the_views_is_told() -> None:
    """In view 2 by some millimetres across and degrees in the plane, on pixels of 3 mm."""
    truth = true_poses()
    still = make_scene(truth)
    moved = off(truth.camera1_from["device"], REFERENCE_POINTS["device"], (0, 0, 2.0), (2.0, 1.2, 0))
    elsewhere = make_scene(truth.with_object("device", moved), seed=1).images["device"]
    images = (still.images["device"][0], elsewhere[1], still.images["device"][2])
    held = replace(still, images=still.images | {"device": images})
    for scene, told in ((still, 0), (held, 1)):
        covariance = pose_covariance(scene, truth, _LEVEL, GradNcc(1))
        of_device = [drift for drift in covariance.drifts if drift.objects == ("device",)]
        assert [drift.views for drift in of_device] == [(0,), (1,), (2,)]
        said = doubts_about_motion(covariance, LIMITS, {}, partial(_alone, scene), tuple)
        assert len(said) == told, said
    assert "in the device image of view 2, the device lies elsewhere" in said[0]
    best = max(covariance.drifts, key=lambda drift: drift.gain)
    assert best.views == (1,)


def test_a_leg_that_turned_between_the_views_is_told() -> None:
    """In the images of view 3, without and with the device, on pixels of 3 mm; the femur lies as views 1 and 2 say."""
    truth = true_poses()
    still = make_scene(truth)
    turned = off(truth.camera1_from["femur"], REFERENCE_POINTS["femur"], (0, 0, 3.0), (0.5, 0, 0))
    elsewhere = make_scene(truth.with_object("femur", turned), seed=1).images
    images = {kind: (*of[:2], elsewhere[kind][2]) for kind, of in still.images.items()}
    for scene, told in ((still, 0), (replace(still, images=images), 1)):
        covariance = pose_covariance(scene, truth, _LEVEL, GradNcc(1))
        of_femur = [drift for drift in covariance.drifts if drift.objects == ("femur",)]
        assert [drift.views for drift in of_femur] == [(0,), (1,), (2,)]
        said = doubts_about_motion(covariance, LIMITS, {}, _never, tuple)
        assert len(said) == told, said
    assert "in view 3, the femur lies" in said[0]
    assert float(of_femur[2].motion[2]) == pytest.approx(3.0, abs=0.6)


@pytest.mark.parametrize("degrees", [1.5, -2.0])
def test_a_leg_that_turned_in_its_joint_is_measured(degrees: float) -> None:
    truth = true_poses()
    still = make_scene(truth)
    turned = off(truth.camera1_from["femur"], REFERENCE_POINTS["femur"], (0, 0, degrees), (0, 0, 0))
    elsewhere = make_scene(truth.with_object("femur", turned), seed=1).images
    held = replace(still, images={kind: (*of[:2], elsewhere[kind][2]) for kind, of in still.images.items()})
    before, found = (pose_covariance(scene, truth, _LEVEL, GradNcc(1)).joint_turns for scene in (still, held))
    assert [(each.name, each.view) for each in found] == [("femur", 0), ("femur", 1), ("femur", 2)]
    assert found[2].degrees == pytest.approx(abs(degrees), abs=0.4)
    assert found[2].sureness > 3
    assert found[2].gain == max(each.gain for each in found)
    assert max(each.degrees for each in before) < 0.5


@pytest.mark.parametrize(
    ("degrees", "sigmas", "gain", "told"),
    [(1.3, 4.7, 0.0013, 1), (0.6, 4.7, 0.0013, 0), (1.4, 1.6, 0.0013, 0), (1.3, 4.7, 0.0005, 0)],
)
def test_a_turn_in_a_joint_is_told_that_is_far_and_sure_and_explains_something(
    degrees: float, sigmas: float, gain: float, told: int
) -> None:
    turn = JointTurn(2, "femur", degrees, sigmas, gain)
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)),
        motions=(), drifts=(), guide_drifts=(), joint_turns=(turn,),
    )  # fmt: skip
    said = doubts_about_motion(covariance, LIMITS, {}, _never, tuple)
    assert len(said) == told
    assert all("in view 3, the femur is turned by 1.3° in its joint" in one for one in said)


@pytest.mark.parametrize(
    ("coarse", "finer", "told"),
    [
        (JointTurn(0, "femur", 0.84, 3.1, 0.0003), JointTurn(0, "femur", 0.73, 4.1, 0.0004), 1),  # turned by 0.9°
        (JointTurn(0, "femur", 0.71, 2.8, 0.0006), JointTurn(0, "femur", 0.74, 3.5, 0.0010), 1),  # bent by 0.9°
        (JointTurn(0, "femur", 0.75, 2.6, 0.0003), JointTurn(0, "femur", 0.63, 2.7, 0.0003), 0),  # a right one
        (JointTurn(0, "femur", 0.50, 3.0, 0.0002), JointTurn(0, "femur", 0.73, 4.1, 0.0004), 0),  # not worth it
    ],
)
def test_a_small_turn_in_a_joint_is_asked_of_finer_pixels(coarse: JointTurn, finer: JointTurn, told: int) -> None:
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)),
        motions=(), drifts=(), guide_drifts=(), joint_turns=(coarse,),
    )  # fmt: skip
    said = doubts_about_motion(covariance, LIMITS, {}, _never, lambda: (finer,))
    assert len(said) == told
    assert all("in view 1, the femur is turned by 0.7° in its joint" in one for one in said)


@pytest.mark.parametrize(("gain", "told"), [(0.005, 1), (0.0035, 0)])
def test_a_bone_must_gain_more_than_a_device_to_have_drifted(gain: float, told: int) -> None:
    motion = torch.tensor([0.0, 0.0, 1.5, 0.9, 0.4, 0.0], dtype=torch.float64)
    drift = MotionBetween(None, (1,), ("femur",), motion, motion.abs() / 5 + 1e-9, gain)
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)), motions=(), drifts=(drift,)
    )
    assert len(doubts_about_motion(covariance, LIMITS, {}, _never, tuple)) == told


@pytest.mark.parametrize(
    ("step", "apart", "alone", "told"),
    [
        (0.0020, 0.05, 0.002, 0),  # a right one, whose step promised much
        (0.0010, 0.05, 0.007, 1),  # a handle that sagged
        (0.0011, 0.05, 0.022, 1),  # of little cost, and much of that
        (0.0014, 0.05, 0.003, 0),  # a right one, half before saturated air
        (0.0005, 0.05, 0.007, 0),  # not worth a fit
        (0.0048, 0.177, 0.0021, 1),  # moved by 1.5 mm, and its depth gave way
        (0.0002, 0.160, 0.0031, 0),  # a right one that one view pulls
    ],
)
def test_a_drift_is_told_by_what_fitting_it_alone_gains_or_where_the_views_disagree(
    step: float, apart: float, alone: float, told: int
) -> None:
    motion = torch.tensor([0.0, 0.0, 0.5, 0.9, 0.4, 0.0], dtype=torch.float64)
    drift = MotionBetween("device", (1,), ("device",), motion, motion.abs() / 3 + 1e-9, step)
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)), motions=(), drifts=(drift,)
    )
    assert len(doubts_about_motion(covariance, LIMITS, {"device": apart}, lambda _: alone, tuple)) == told


def _held(way: Tensor, view: int) -> Scene:
    """A scene whose device has a guide, and lay elsewhere in one view's image: moved by a twist along its own axes."""
    truth = true_poses()
    still = make_scene(truth)
    base = _GUIDE[0]
    device = replace(still.objects["device"], guide=_GUIDE)
    about_base = truth.camera1_from["device"] @ about_point(exp_se3(way), base)
    moved = make_scene(truth.with_object("device", about_base), seed=1).images["device"]
    images = tuple(moved[n] if n == view else still.images["device"][n] for n in range(3))
    return replace(still, images=still.images | {"device": images}, objects=still.objects | {"device": device})


_GUIDE = torch.tensor([0.0, 0, -40], dtype=torch.float64), torch.tensor([0.0, 0, 40], dtype=torch.float64)
_SLIDE = torch.tensor([0.0, 0, 0, 0, 0, 1.0], dtype=torch.float64)
_TURNED = torch.tensor([0.0, 0, math.radians(5), 0, 0, 0], dtype=torch.float64)


@pytest.mark.parametrize(("way", "turns", "amount"), [(_SLIDE, False, 1.0), (_TURNED, True, 5.0)])
@pytest.mark.parametrize("view", [0, 1, 2])
def test_a_slide_or_a_turn_in_one_view_is_measured(way: Tensor, turns: bool, amount: float, view: int) -> None:
    """By an independent motion of the device in the image of that view, on pixels of 3 mm."""
    covariance = pose_covariance(_held(way, view), true_poses(), _LEVEL, GradNcc(1))
    found = {(each.view, each.turns): each for each in covariance.guide_drifts}
    assert set(found) == {(n, t) for n in range(3) for t in (False, True)}
    moved = found[view, turns]
    assert moved.amount == pytest.approx(amount, abs=1.5 * moved.deviation)
    assert moved.sureness > 2
    assert max((found[n, turns] for n in range(3)), key=lambda each: each.gain) == moved


def test_a_device_that_was_held_still_neither_slides_nor_turns() -> None:
    covariance = pose_covariance(_held(torch.zeros(6, dtype=torch.float64), 1), true_poses(), _LEVEL, GradNcc(1))
    assert max(each.sureness for each in covariance.guide_drifts) < 3
    assert doubts_about_guides(covariance, LIMITS) == ()


def test_a_round_device_is_not_asked_for_its_turn() -> None:
    scene = _held(_SLIDE, 1)
    axis = Axis(torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    scene = replace(scene, objects=scene.objects | {"device": replace(scene.objects["device"], axis=axis)})
    covariance = pose_covariance(scene, true_poses(), _LEVEL, GradNcc(1))
    assert {each.turns for each in covariance.guide_drifts} == {False}


@pytest.mark.parametrize(
    ("turns", "amount", "sigmas", "gain", "words"),
    [
        (False, 1.4, 5, 0.001, "view 2, the device lies 1.4 mm along its guide"),
        (True, -3.4, 2.5, 0.001, "view 2, the device is turned by 3° about its guide"),
        (False, 0.4, 5, 0.001, None),  # small
        (True, 1.5, 5, 0.001, None),
        (False, 1.4, 2, 0.0005, None),  # unsure
        (False, 1.4, 2, 0.001, "view 2, the device lies 1.4 mm along its guide"),  # explains more
        (False, 1.4, 0.9, 0.001, None),
        (True, 3.4, 1.0, 0.001, None),
        (False, 1.4, 5, 0.0001, None),  # explains nothing
        (True, 3.4, 2.5, 0.0001, None),
    ],
)
def test_what_is_far_sure_and_explains_something_is_told(
    turns: bool, amount: float, sigmas: float, gain: float, words: str | None
) -> None:
    found = GuideDrift("device", 1, "device", turns, amount, abs(amount) / sigmas, gain)
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)), drifts=(), guide_drifts=(found,)
    )
    told = doubts_about_motion(covariance, LIMITS, {}, _never, tuple)
    assert len(told) == (words is not None)
    assert words is None or words in told[0]


@pytest.mark.parametrize(("most_deg", "turns", "told"), [(90.0, True, 1), (0.0, True, 0), (0.0, False, 1)])
def test_a_turn_in_one_view_is_not_told_where_the_images_leave_the_rotation_open(
    most_deg: float, turns: bool, told: int
) -> None:
    found = GuideDrift("device", 1, "device", turns, 3.4, 0.6, 0.001)
    covariance = replace(
        pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1)), drifts=(), guide_drifts=(found,)
    )
    assert len(doubts_about_motion(covariance, Limits(most_deviation_deg=most_deg), {}, _never, tuple)) == told


@pytest.mark.parametrize(("gain", "told"), [(0.0025, False), (0.012, True)])
def test_only_what_explains_much_may_be_the_cause_of_what_speaks_against_the_carm(gain: float, told: bool) -> None:
    covariance = pose_covariance(make_scene(true_poses()), true_poses(), _LEVEL, GradNcc(1))
    assert not explains_the_carm(covariance)
    turned = JointTurn(1, "femur", 2.5, 4.0, gain)
    assert explains_the_carm(replace(covariance, joint_turns=(turned,))) == told
    device = replace(covariance.drifts[0], kind="device", gain=1.0)  # a device that moved moves no C-arm
    assert not explains_the_carm(replace(covariance, drifts=(device,), joint_turns=()))
