"""Poses that bring three points exactly onto three pixels, by OpenCV."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def three_point_poses(points: Array, pixels: Array, matrix: Array) -> Iterator[Array]:
    """Up to four `camera_from_object` (4, 4) of three points (3, 3), mm, seen at pixels (3, 2) (column, row).

    `matrix` (3, 3) is the camera's. AP3P: Ke and Roumeliotis, CVPR 2017. None for points in one line.
    """
    _, rotations, translations = cv2.solveP3P(points, pixels, matrix, None, flags=cv2.SOLVEPNP_AP3P)
    for rotation, translation in zip(rotations, translations, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rotation)[0]
        pose[:3, 3] = translation.ravel()
        if np.isfinite(pose).all():
            yield pose


def refined_pose(pose: Array, points: Array, pixels: Array, matrix: Array) -> Array:
    """The `camera_from_object` (4, 4) of least squared reprojection residuals near `pose`, by Levenberg–Marquardt."""
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, matrix, None, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
    )
    found = np.eye(4)
    found[:3, :3] = cv2.Rodrigues(rotation)[0]
    found[:3, 3] = translation.ravel()
    return found
