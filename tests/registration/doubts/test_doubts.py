"""Doubts about C-arm poses and plans."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from registration_scenes import CARM, float64, make_scene, true_poses

from femoreg_torch.case import Case, CaseObject, PlannedPath
from femoreg_torch.case.model import Model
from femoreg_torch.geometry import Poses, about_point, exp_se3
from femoreg_torch.registration.doubts.ask import _likeliest_first
from femoreg_torch.registration.doubts.carm import doubts_about_the_views
from femoreg_torch.registration.doubts.plan import doubts_about_the_guide, doubts_about_the_plan
from femoreg_torch.registration.evidence.motion import MotionBetween
from femoreg_torch.registration.orbit import rolled
from femoreg_torch.registration.scene import Scene

TRUTH = true_poses()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def moved(view: int, rotation: float, shift: float):
    """The true poses with the C-arm of one view (from 0) tilted about the isocentre and shifted."""
    twist = float64(rotation, 0, 0, 0, shift, 0)[None]
    motion = about_point(exp_se3(twist), float64(*CARM.isocentre_mm))[0]
    return TRUTH.with_view(view, motion @ TRUTH.camera_from_camera1[view])


def test_views_near_the_orbit_are_believed(scene: Scene) -> None:
    assert doubts_about_the_views(scene, TRUTH) == ()
    assert doubts_about_the_views(scene, moved(1, 0.1, 20)) == ()
    assert doubts_about_the_views(scene, moved(1, 0.4, 20)) == ()  # towards head or feet


def test_a_view_that_is_rolled_as_far_as_it_is_looked_for_is_believed(scene: Scene) -> None:
    for camera in rolled(scene, TRUTH, 30)[::5]:
        assert doubts_about_the_views(scene, TRUTH.with_view(1, camera)) == ()


@pytest.mark.parametrize(("rotation", "shift"), [(1.0, 0), (0, 120)])
def test_a_view_far_off_the_orbit_is_doubted(scene: Scene, rotation: float, shift: float) -> None:
    (doubt,) = doubts_about_the_views(scene, moved(2, rotation, shift))
    assert "view 3" in doubt
    assert "mirrored" in doubt


def test_given_poses_are_not_doubted(scene: Scene) -> None:
    far = moved(2, 0, 120)
    assert doubts_about_the_views(replace(scene, camera_from_camera1=far.camera_from_camera1), far) == ()


def planned(entry, target) -> Case:
    path = PlannedPath("pelvis", float64(*entry), float64(*target))
    return Case(Path(), CARM, {"pelvis": CaseObject("pelvis", ("pelvis",))}, plan=path)


def test_a_plan_in_the_bone_is_believed(scene: Scene) -> None:
    assert doubts_about_the_plan(planned((-5, 0, 0), (10, 5, 0)), scene) == ()
    assert doubts_about_the_plan(replace(planned((0, 0, 0), (1, 1, 1)), plan=None), scene) == ()


@pytest.mark.parametrize(
    ("entry", "target", "says"), [((0, 0, 300), (0, 0, 0), "entry point"), ((0, 0, 0), (0, 300, 0), "target")]
)
def test_a_plan_off_the_bone_is_doubted(scene: Scene, entry, target, says: str) -> None:
    (doubt,) = doubts_about_the_plan(planned(entry, target), scene)
    assert says in doubt
    assert "LPS" in doubt


def test_a_path_that_leaves_the_bone_is_doubted(scene: Scene) -> None:
    """Between two corners of an L, so to speak: with the middle of the object taken out."""
    volume = scene.objects["pelvis"].volume
    data = volume.data.clone()
    data[10:-10] = 0
    hollow = replace(scene.objects["pelvis"], volume=volume.with_data(data))
    rows = data.nonzero().double().flip(1) @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]
    low, high = rows[rows[:, 2].argmin()].tolist(), rows[rows[:, 2].argmax()].tolist()
    (doubt,) = doubts_about_the_plan(planned(low, high), replace(scene, objects=scene.objects | {"pelvis": hollow}))
    assert "leaves" in doubt
    assert torch.isfinite(torch.tensor(low)).all()


@pytest.mark.parametrize(("tip", "base", "told"), [(100.0, 0.0, 0), (0.0, 100.0, 1)])
def test_a_guide_that_points_out_of_the_bone_is_doubted(tip: float, base: float, told: int) -> None:
    """Tip and base of the device exchanged: its pose is right, and the tip is told a device's length away."""
    path = PlannedPath("pelvis", float64(0, 0, 0), float64(10, 0, 80), "drill")
    points = {"tip": float64(0, 0, tip), "base": float64(0, 0, base)}
    drill = CaseObject("drill", model=Model(Path("drill.stl"), 5000.0), points=points)
    case = Case(Path(), CARM, {"pelvis": CaseObject("pelvis", ("pelvis",)), "drill": drill}, plan=path)
    pose = torch.eye(4, dtype=torch.float64)
    poses = Poses(pose[None], {"pelvis": pose, "drill": pose})
    doubts = doubts_about_the_guide(case, poses)
    assert len(doubts) == told
    assert all("`tip` and `base` exchanged" in doubt and "Is `side` the one" in doubt for doubt in doubts)
    assert doubts_about_the_guide(case, Poses(pose[None], {"pelvis": pose})) == ()


def motion(gain: float, kind: str | None) -> MotionBetween:
    """What a bone, or anatomy, would move by, surely."""
    far, sure = torch.ones(6, dtype=torch.float64), torch.full((6,), 0.01, dtype=torch.float64)
    return MotionBetween(kind, (1,), ("pelvis",), far, sure, gain)


def test_the_likeliest_cause_is_told_first() -> None:
    def order(motions: list[MotionBetween], drifts: list[MotionBetween]) -> tuple[str, ...]:
        found = SimpleNamespace(motions=motions, drifts=drifts, joint_turns=[])
        return _likeliest_first(found)  # type: ignore[arg-type]

    still, moved, drifted = order([], []), order([motion(0.002, "device")], []), order([], [motion(0.02, None)])
    assert len(set(still)) == len(still)
    assert set(still) == set(moved) == set(drifted)
    assert still[0] == "CT"
    assert still.index("C-arm") < still.index("size") < still.index("rigidity") < still.index("motion")
    assert moved.index("motion") < moved.index("size")
    assert drifted.index("rigidity") < drifted.index("motion") < drifted.index("C-arm")
