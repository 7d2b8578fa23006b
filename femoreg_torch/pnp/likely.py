"""The most probable pose by few landmarks, and by what views of a patient look like.

Two or three landmarks about one hip fix no pose. With what is usual of a view (the beam near an axis of the patient,
the patient's axis near the image's columns, the patient in the middle between source and detector) they tell where to
look for one. What is left open stands in the covariance, for the outlines of bones to settle.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.geometry import Camera
from femoreg_torch.pnp.solve import INLIER_MM, PnpResult, by_huber, movable

Array = NDArray[np.float64]

# Standard deviations: of the beam about the axis that it runs along, each way; of the patient's axis about the image's
# columns; and of the landmarks' middle from a depth, both over the source-to-detector distance. The first is that of
# `pnp.solve`; the others are choices, that hold the paper's views and those of mobile C-arms over a table.
_TILT_DEG, _ROLL_DEG = 30.0, 20.0
_DEPTH, _DEPTH_DEVIATION = 0.68, 0.12


def likely_pose(
    points: Tensor,
    pixels: Tensor,
    camera: Camera,
    deviations_px: Tensor,
    point_deviations_mm: Tensor,
    beam: tuple[float, float, float],
    turned: bool = False,
) -> PnpResult:
    """The most probable pose of points (N, 3), LPS mm, seen at pixels (N, 2); N is at least one.

    `deviations_px` (N,), `point_deviations_mm` (N,) and `beam` are as for `solve_pnp`. The image is as the source sees
    it, the patient's head up, or down where it is `turned`.
    """
    seen = pixels.double().numpy()
    magnified = point_deviations_mm.double().numpy() / _DEPTH / camera.mean_pixel_mm
    spread = np.hypot(deviations_px.double().numpy(), magnified)
    object_points = points.double().numpy()
    along = np.asarray(beam, dtype=np.float64)
    down = np.array([0.0, 0.0, 1.0 if turned else -1.0])
    ray = np.linalg.solve(camera.matrix().numpy(), np.append(seen.mean(0), 1.0))
    usual = np.eye(4)
    usual[:3, :3] = np.stack([np.cross(down, along), down, along])
    usual[:3, 3] = _DEPTH * camera.sdd_mm * ray / ray[2] - usual[:3, :3] @ object_points.mean(0)
    moving = movable(usual, object_points, camera)
    deviations = np.array([*[np.radians(_TILT_DEG)] * 2, np.radians(_ROLL_DEG), _DEPTH_DEVIATION * camera.sdd_mm])

    def residuals(twist: Array) -> Array:
        offset = (moving.pixels(twist) - seen) / spread[:, None]
        return np.append(by_huber(offset).ravel(), twist[[0, 1, 2, 5]] / deviations)

    found = least_squares(residuals, np.zeros(6), x_scale=(0.1, 0.1, 0.1, 10, 10, 50))
    distances = np.linalg.norm(moving.pixels(found.x) - seen, axis=1)
    inliers = distances < INLIER_MM / camera.mean_pixel_mm
    rms_px = float(np.sqrt((distances[inliers] ** 2).mean())) if inliers.any() else float("nan")
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    return PnpResult(moving.pose(found.x, usual), torch.from_numpy(inliers), rms_px, torch.from_numpy(covariance))
