"""The most probable pose by few landmarks: exact ones of many points, and what it leaves open of few."""

import math

import pytest
import torch

from femoreg_torch.geometry import (
    about_point,
    exp_so3,
    load_carm,
    pose_difference,
    project_points,
    rigid,
    transform_points,
)
from femoreg_torch.pnp import likely_pose

CAMERA = load_carm("cios_fusion").camera
AP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]).double()
BEAM = (0.0, 1.0, 0.0)


def posed(turn_deg: tuple[float, float, float], at: tuple[float, float, float]) -> torch.Tensor:
    turn = exp_so3(torch.deg2rad(torch.tensor(turn_deg, dtype=torch.float64)))
    return rigid(turn, torch.tensor(at, dtype=torch.float64)) @ AP


def points(count: int) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 50


def found_of(truth: torch.Tensor, marks: torch.Tensor, sigma_px: float):
    pixels = project_points(CAMERA, transform_points(truth, marks))
    sigma = torch.full((len(marks),), sigma_px).double()
    return likely_pose(marks, pixels, CAMERA, sigma, torch.zeros(len(marks)).double(), BEAM)


def test_many_sure_landmarks_outweigh_what_is_usual() -> None:
    truth, marks = posed((20, -25, 15), (30, -40, 850)), points(10)
    found = found_of(truth, marks, 0.05)
    assert pose_difference(truth, found.camera_from_object, marks.mean(0)) == pytest.approx((0, 0), abs=0.2)
    assert found.inliers.all()
    assert found.rms_px < 0.05
    assert found.rotation_deviation_deg < 0.2


def test_one_landmark_tells_where_across_and_the_rest_is_as_usual() -> None:
    marks = points(1)
    truth = posed((0, 0, 0), (0, 0, 0.68 * CAMERA.sdd_mm)) @ rigid(torch.eye(3).double(), -marks[0])
    found = found_of(truth, marks, 4.0)
    assert pose_difference(truth, found.camera_from_object, marks[0]) == pytest.approx((0, 0), abs=1e-3)
    deviation = found.covariance.diagonal().sqrt()
    torch.testing.assert_close(torch.rad2deg(deviation[:3]), torch.tensor([30.0, 30, 20]).double(), rtol=1e-3, atol=0)
    assert float(deviation[5]) == pytest.approx(0.12 * CAMERA.sdd_mm, rel=0.01)
    across = 4.0 * CAMERA.mean_pixel_mm * 0.68
    assert float(deviation[3]) == pytest.approx(across, rel=0.05)


def test_a_patient_on_the_side_is_looked_for_along_its_own_beam() -> None:
    side = torch.tensor([[0.0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 700], [0, 0, 0, 1]]).double()
    marks = points(3)
    turned = about_point(
        rigid(exp_so3(torch.tensor([0.0, 0.0, math.radians(5)]).double()), torch.zeros(3).double()), side[:3, 3]
    )
    pixels = project_points(CAMERA, transform_points(turned @ side, marks))
    sigma = torch.ones(3).double()
    pose = likely_pose(marks, pixels, CAMERA, sigma, 0 * sigma, (-1.0, 0.0, 0.0)).camera_from_object
    assert pose_difference(turned @ side, pose, marks.mean(0))[0] < 15
    assert pose[2, 0] < -0.9


def test_an_image_that_stands_on_its_head_is_looked_at_so() -> None:
    head_down = rigid(exp_so3(torch.tensor([0.0, 0.0, math.pi]).double()), torch.zeros(3).double())
    truth, marks = (
        about_point(head_down, torch.tensor([20.0, 10.0, 690.0]).double()) @ posed((3, 4, 5), (20, 10, 690)),
        points(2),
    )
    pixels = project_points(CAMERA, transform_points(truth, marks))
    sigma = torch.ones(2).double()
    pose = likely_pose(marks, pixels, CAMERA, sigma, 0 * sigma, BEAM, turned=True).camera_from_object
    assert pose_difference(truth, pose, marks.mean(0))[0] < 15
