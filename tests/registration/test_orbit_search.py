"""The search along the orbit, of C-arms that left it."""

import math
from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, error, float64, make_scene, true_poses

from femoreg_torch.geometry import Poses, about_point, exp_se3, transform_points
from femoreg_torch.registration import Level, OrbitSearch
from femoreg_torch.registration.orbit import search_orbit
from femoreg_torch.similarity import GradNcc

SEARCH = OrbitSearch("orbit", ["anatomy"], ["pelvis", "femur"], 40, 1, Level(3.0, 2.0), GradNcc(patch_radius=3))
OFF_MM = (-14.0, 18.0, 8.0)


def moved(view: int) -> Poses:
    """The true poses, and the patient seen from a view (from 0) centimetres beside where the orbit has it."""
    poses = true_poses()
    pelvis = transform_points(poses.camera_from("pelvis")[view], REFERENCE_POINTS["pelvis"][None])[0]
    off = about_point(exp_se3(float64(0.01, -0.012, 0.015, *OFF_MM)), pelvis)
    return poses.with_view(view, off @ poses.camera_from_camera1[view])


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
    scene = make_scene(truth, with_device=False)
    search = replace(SEARCH, shift_mm=30.0, further_deg=100.0, further_above=0.6)
    found = search_orbit(scene, truth.with_view(1, torch.eye(4, dtype=torch.float64)), search, 1)
    mm, deg = error(found.poses.camera_from("pelvis")[1], truth.camera_from("pelvis")[1], REFERENCE_POINTS["pelvis"])
    assert mm < 25  # along the beam
    assert deg < 3
    assert found.evaluations == 81 + 12 + 2 * 201 + 12


def test_a_view_that_fits_is_looked_for_no_further() -> None:
    truth = true_poses()
    scene = make_scene(truth, with_device=False)
    search = replace(SEARCH, further_deg=100.0, further_above=0.95)
    assert search_orbit(scene, truth, search, 1).evaluations == 81
