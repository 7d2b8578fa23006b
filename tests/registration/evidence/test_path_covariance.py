"""How uncertain one object is beside another, against motions that are drawn and carried out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from registration_scenes import REFERENCE_POINTS, make_scene, true_poses
from scipy.spatial.transform import Rotation

from femoreg_torch.case import Case
from femoreg_torch.case.model import PlannedPath
from femoreg_torch.geometry import transform_points
from femoreg_torch.registration.evidence.covariance import IntrinsicsEstimate, PoseCovariance
from femoreg_torch.registration.quality import Limits, final_covariance, path_covariance


def test_one_object_beside_another_at_a_point() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(12, 12)) * np.tile([0.05] * 3 + [0.2] * 3, 2)[:, None]
    matrix = root @ root.T
    centres = np.array([[10.0, -20.0, 700.0], [60.0, 5.0, 640.0]])
    point = np.array([90.0, 10.0, 690.0])
    none = IntrinsicsEstimate(torch.zeros(3), torch.zeros(3))
    covariance = PoseCovariance(
        ("femur", "device"),
        torch.from_numpy(matrix),
        torch.from_numpy(4 * matrix),
        torch.from_numpy(centres),
        none,
        torch.zeros(12),
    )
    drawn = rng.multivariate_normal(np.zeros(12), matrix, size=20000)
    turns = [Rotation.from_rotvec(drawn[:, i : i + 3], degrees=True) for i in (0, 6)]
    moved = [
        turn.apply(point - centre) + centre + drawn[:, i + 3 : i + 6]
        for turn, centre, i in zip(turns, centres, (0, 6), strict=True)
    ]
    seen = np.c_[moved[1] - moved[0], drawn[:, 6:9] - drawn[:, :3]]
    found = covariance.beside("device", "femur", torch.from_numpy(point), images_only=False).numpy()
    scale = np.sqrt(np.diagonal(found))
    np.testing.assert_allclose(np.cov(seen.T) / np.outer(scale, scale), found / np.outer(scale, scale), atol=0.05)
    by_images = covariance.beside("device", "femur", torch.from_numpy(point), images_only=True).numpy()
    np.testing.assert_allclose(by_images, 4 * found)
    same = covariance.beside("femur", "femur", torch.from_numpy(point), images_only=False)
    assert same.abs().max() < 1e-12  # what moves both together does not count


def test_what_a_point_on_both_sees_is_told_as_relative_mm() -> None:
    root = np.random.default_rng(5).normal(size=(12, 12)) * 0.1
    centres = torch.tensor([[0.0, 0, 700], [50, 0, 650]], dtype=torch.float64)
    matrix = torch.from_numpy(root @ root.T)
    none = IntrinsicsEstimate(torch.zeros(3), torch.zeros(3))
    covariance = PoseCovariance(("femur", "device"), matrix, matrix, centres, none, torch.zeros(12))
    at_device = covariance.beside("device", "femur", centres[1], images_only=False)
    np.testing.assert_allclose(at_device.diagonal()[:3].sqrt(), covariance.relative_mm("device", "femur"))


def test_a_path_is_uncertain_by_what_the_images_leave_open() -> None:
    """At the truth of drawn views: tenths of a mm, and along the axes of the femur, whatever camera 1 calls them."""
    truth = true_poses()
    scene = make_scene(truth)
    covariance = final_covariance(scene, truth)
    plan = PlannedPath("femur", REFERENCE_POINTS["femur"], REFERENCE_POINTS["femur"] + 10, "device")
    case = Case(Path(), scene.carm, {}, plan=plan)
    found = path_covariance(case, scene, truth, covariance, Limits())
    assert found is not None
    deviations = found.diagonal().sqrt()
    assert 0.001 < deviations[:3].max() < 0.5
    assert 0.001 < deviations[3:].max() < 0.6
    turn = truth.camera1_from["femur"][:3, :3]
    entry = transform_points(truth.camera1_from["femur"], plan.entry_point[None])[0]
    seen = covariance.beside("device", "femur", entry, images_only=True)
    torch.testing.assert_close(turn @ found[:3, :3] @ turn.T, seen[:3, :3])
    torch.testing.assert_close(turn @ found[3:, 3:] @ turn.T, seen[3:, 3:])
    assert path_covariance(replace(case, plan=None), scene, truth, covariance, Limits()) is None
