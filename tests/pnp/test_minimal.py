"""Exact poses from three points, and the least-squares pose near a start, against OpenCV's own projection."""

import cv2
import numpy as np
import pytest

from femoreg_torch.pnp import refined_pose, three_point_poses

MATRIX = np.array([[5257.0, 0, 767.5], [0, 5257, 767.5], [0, 0, 1]])
POINTS = np.array([[0.0, 0, 0], [40, 3, -8], [12, 35, 6], [-20, 14, 22], [8, -17, 30]])


def true_pose() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.7, -0.4, 0.3]))[0]
    pose[:3, 3] = (12, -20, 740)
    return pose


def drawn(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return cv2.projectPoints(points, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], MATRIX, None)[0][:, 0]


def test_three_points_have_the_true_pose_among_at_most_four() -> None:
    found = list(three_point_poses(POINTS[:3], drawn(true_pose(), POINTS[:3]), MATRIX))
    assert 1 <= len(found) <= 4
    assert min(np.abs(pose - true_pose()).max() for pose in found) < 1e-6
    for pose in found:
        np.testing.assert_allclose(drawn(pose, POINTS[:3]), drawn(true_pose(), POINTS[:3]), atol=1e-4)


@pytest.mark.parametrize("count", [4, 5])
def test_refinement_ends_at_the_truth(count: int) -> None:
    start = true_pose()
    start[:3, :3] = cv2.Rodrigues(np.array([0.05, -0.04, 0.03]))[0] @ start[:3, :3]
    start[:3, 3] += (3, -2, 15)
    found = refined_pose(start, POINTS[:count], drawn(true_pose(), POINTS[:count]), MATRIX)
    np.testing.assert_allclose(found, true_pose(), atol=1e-4)
    assert not np.array_equal(start, found)
