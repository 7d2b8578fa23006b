"""How uncertain one object is beside another, against motions that are drawn and carried out."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from femoreg_torch.registration.covariance import IntrinsicsEstimate, PoseCovariance


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
