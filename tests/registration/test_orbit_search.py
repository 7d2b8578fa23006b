"""The search along the orbit, of C-arms that left it."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, error, float64, make_scene, true_poses

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
