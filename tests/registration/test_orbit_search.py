"""The search along the orbit, of C-arms that left it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, error, float64, make_scene, true_poses
from scipy.spatial.transform import Rotation

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.geometry import Poses, about_point, exp_se3, exp_so3, rigid, transform_points
from femoreg_torch.registration import Level, OrbitSearch
from femoreg_torch.registration.orbit import search_orbit, tilted
from femoreg_torch.similarity import GradNcc

SEARCH = OrbitSearch("orbit", ["anatomy"], ["pelvis", "femur"], 40, 1, Level(3.0, 2.0), GradNcc(patch_radius=3))
OFF_MM = (-14.0, 18.0, 8.0)


def moved(view: int) -> Poses:
    """The true poses, and the patient seen from a view (from 0) centimetres beside where the orbit has it."""
    poses = true_poses()
    pelvis = transform_points(poses.camera_from("pelvis")[view], REFERENCE_POINTS["pelvis"][None])[0]
    off = about_point(exp_se3(float64(0.01, -0.012, 0.015, *OFF_MM)), pelvis)
    return poses.with_view(view, off @ poses.camera_from_camera1[view])


def looked_for_further(truth: Poses, further_above: float) -> tuple[StageRecord, float, float]:
    """What the search from view 1 finds of view 2, and how far the pelvis is off there, mm and degrees."""
    search = replace(SEARCH, shift_mm=30.0, further_deg=100.0, further_above=further_above)
    known = truth.with_view(1, torch.eye(4, dtype=torch.float64))
    found = search_orbit(make_scene(truth, with_device=False), known, search, 1)
    mm, deg = error(found.poses.camera_from("pelvis")[1], truth.camera_from("pelvis")[1], REFERENCE_POINTS["pelvis"])
    return found, mm, deg


@pytest.mark.parametrize("view", [1, 2])
def test_a_view_beside_the_orbit_is_found(view: int) -> None:
    truth = moved(view)
    scene = make_scene(truth, with_device=False)
    known = truth.with_view(view, torch.eye(4, dtype=torch.float64))
    along, beside = (search_orbit(scene, known, replace(SEARCH, shift_mm=mm), view) for mm in (0.0, 30.0))
    offs = [
        error(record.poses.camera_from("pelvis")[view], truth.camera_from("pelvis")[view], REFERENCE_POINTS["pelvis"])
        for record in (along, beside)
    ]
    assert offs[0][0] > 15
    mm, deg = offs[1]
    assert mm < 14  # most of it along the beam, where a shift of the image says nothing
    assert deg < 3
    assert beside.cost < along.cost - 0.1
    assert beside.evaluations == 81 + 12


def test_a_view_on_the_orbit_is_found_as_well() -> None:
    truth = true_poses()
    scene = make_scene(truth, with_device=False)
    for view in (1, 2):
        found = search_orbit(scene, truth, replace(SEARCH, shift_mm=30.0), view).poses
        mm, deg = error(
            found.camera_from("pelvis")[view], truth.camera_from("pelvis")[view], REFERENCE_POINTS["pelvis"]
        )
        assert mm < 7
        assert deg < 2


@pytest.mark.parametrize(("angle_deg", "centred"), [(72.0, False), (-85.0, False), (80.0, True), (-30.0, True)])
def test_a_view_from_far_off_is_found(angle_deg: float, centred: bool) -> None:
    """Beyond the range of the orbit, and where the patient was centred anew, 100 mm from where the orbit has it."""
    poses = true_poses()
    depth = float(transform_points(poses.camera1_from["femur"], REFERENCE_POINTS["femur"][None])[0, 2])
    carm = replace(CARM, isocentre_mm=(0.0, 0.0, depth)) if centred else CARM
    truth = poses.with_view(1, carm.orbit(float64(math.radians(angle_deg))))
    found, mm, deg = looked_for_further(truth, 0.6)
    assert mm < 25  # along the beam
    assert deg < 3
    assert found.evaluations == 81 + 12 + 2 * (51 + 12) + 31 * (9 + 8) + 12 + (4 * 31 + 12) + 105 + 12


@pytest.mark.parametrize(("turn_deg", "tilt_deg", "tilted_first"), [(25, 18, False), (-30, -15, True), (6, 24, False)])
def test_a_tilted_view_is_found(turn_deg: float, tilt_deg: float, tilted_first: bool) -> None:
    """Towards head or feet, by C-arms that tilt what turns or turn what tilts, from a view 1 that is tilted itself."""
    poses = true_poses()
    turn, tilt = float64(0, math.radians(turn_deg), 0), float64(math.radians(tilt_deg), 0, 0)
    upright = exp_so3(float64(math.radians(-10), 0, 0))  # of the patient's own axes, 10° off those of view 1
    order = [exp_so3(turn), exp_so3(tilt)] if tilted_first else [exp_so3(tilt), exp_so3(turn)]
    pelvis = transform_points(poses.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"][None])[0]
    moved_by = about_point(rigid(upright.mT @ order[0] @ order[1] @ upright), pelvis)
    truth = poses.with_view(1, moved_by)
    scene = make_scene(truth, with_device=False)
    search = replace(SEARCH, shift_mm=30.0, further_deg=100.0, further_above=0.5)
    known = truth.with_view(1, torch.eye(4, dtype=torch.float64))
    along = search_orbit(scene, known, replace(search, further_deg=0.0), 1)
    found = search_orbit(scene, known, search, 1)
    offs = [
        error(record.poses.camera_from("pelvis")[1], truth.camera_from("pelvis")[1], REFERENCE_POINTS["pelvis"])[1]
        for record in (along, found)
    ]
    assert offs[0] > 10
    assert offs[1] < 5


@pytest.mark.parametrize(("turn_deg", "roll_deg"), [(7, -9), (-32, 8), (25, 15)])
def test_a_rolled_view_is_found(turn_deg: float, roll_deg: float) -> None:
    """Turned in its plane, as by a C-arm that swings, and a little beside where that leaves the pelvis."""
    poses = true_poses()
    pelvis = transform_points(poses.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"][None])[0]
    turn, roll = float64(0, math.radians(turn_deg), 0), float64(0, 0, math.radians(roll_deg))
    moved_by = about_point(exp_se3(torch.cat([roll, float64(9, -7, 5)])) @ rigid(exp_so3(turn)), pelvis)
    truth = poses.with_view(1, moved_by)
    _, mm, deg = looked_for_further(truth, 0.3)
    assert mm < 20  # along the beam
    assert deg < 3


def test_tilted_c_arms_turn_and_tilt_by_the_patients_axes() -> None:
    """Against rotations by SciPy, from a view 1 that is turned, tilted and rolled itself."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    about = Rotation.from_euler
    for first in ("zxy", "zyx"):  # uppercase would turn the other way round: what stands last turns first
        view_1 = about(first.upper(), [8.0, -12.0, 20.0], degrees=True).as_matrix() @ upright
        pose = rigid(torch.from_numpy(view_1), float64(10, 20, 600))
        middle = transform_points(pose, float64(0, 0, 0)[None])[0]
        moved = tilted(pose, middle, float64(math.radians(-30.0)))
        after = (moved @ pose)[:, :3, :3].numpy()
        turned = [20.0 - 30.0, -12.0 + 16.0] if first == "zxy" else [-12.0 - 30.0, 20.0 + 16.0]
        angles = [8.0, *(turned[::-1] if first == "zxy" else turned)]
        expected = about(first.upper(), angles, degrees=True).as_matrix() @ upright
        assert np.abs(after - expected).max((1, 2)).min() < 1e-9
        places = transform_points(moved, middle[None])
        torch.testing.assert_close(places, middle.expand_as(places))


def test_a_view_that_fits_is_looked_for_no_further() -> None:
    truth = true_poses()
    scene = make_scene(truth, with_device=False)
    search = replace(SEARCH, further_deg=100.0, further_above=0.95)
    assert search_orbit(scene, truth, search, 1).evaluations == 81
