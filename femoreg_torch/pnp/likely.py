"""The most probable pose by few landmarks, and by what views of a patient look like.

Two or three landmarks about one hip fix no pose. With what is usual of a view (the beam near an axis of the patient,
the patient's axis near the image's columns, the patient in the middle between source and detector) they tell where to
look for one. What is left open stands in the covariance, for the outlines of bones to settle.
"""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.geometry import Camera
from femoreg_torch.pnp.solve import INLIER_MM, PnpResult

Array = NDArray[np.float64]

# Standard deviations: of the beam about the axis that it runs along, each way; of the patient's axis about the image's
# columns; and of the landmarks' middle from a depth, both over the source-to-detector distance. The first is that of
# `pnp.solve`; the others are choices, that hold the paper's views and those of mobile C-arms over a table.
_TILT_DEG, _ROLL_DEG = 30.0, 20.0
_DEPTH, _DEPTH_DEVIATION = 0.68, 0.12
_HUBER_DEVIATIONS = 1.5


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
    seen, matrix = pixels.double().numpy(), camera.matrix().numpy()
    magnified = point_deviations_mm.double().numpy() / _DEPTH / camera.mean_pixel_mm
    spread = np.hypot(deviations_px.double().numpy(), magnified)
    middle = points.double().numpy().mean(0)
    arms = points.double().numpy() - middle
    along = np.asarray(beam, dtype=np.float64)
    down = np.array([0.0, 0.0, 1.0 if turned else -1.0])
    nominal = np.stack([np.cross(down, along), down, along])
    depth = _DEPTH * camera.sdd_mm
    ray = np.linalg.solve(matrix, np.append(seen.mean(0), 1.0))
    centre = depth * ray / ray[2]
    usual = np.array([np.radians(_TILT_DEG)] * 2 + [np.radians(_ROLL_DEG)])

    def off_px(twist: Array) -> Array:
        shadow = (arms @ (cv2.Rodrigues(twist[:3])[0] @ nominal).T + centre + twist[3:]) @ matrix.T
        return np.asarray(shadow[:, :2] / shadow[:, 2:] - seen)

    def residuals(twist: Array) -> Array:
        offset = off_px(twist) / spread[:, None]
        length = np.linalg.norm(offset, axis=1, keepdims=True).clip(1e-12)
        linear = np.sqrt(np.maximum(2 * _HUBER_DEVIATIONS * length - _HUBER_DEVIATIONS**2, 0)) / length
        counted = np.where(length < _HUBER_DEVIATIONS, 1, linear) * offset
        return np.concatenate([counted.ravel(), twist[:3] / usual, twist[5:] / (_DEPTH_DEVIATION * camera.sdd_mm)])

    found = least_squares(residuals, np.zeros(6), x_scale=(0.1, 0.1, 0.1, 10, 10, 50))
    turn = cv2.Rodrigues(found.x[:3])[0] @ nominal
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = centre + found.x[3:] - turn @ middle
    distances = np.linalg.norm(off_px(found.x), axis=1)
    inliers = distances < INLIER_MM / camera.mean_pixel_mm
    rms_px = float(np.sqrt((distances[inliers] ** 2).mean())) if inliers.any() else float("nan")
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    return PnpResult(torch.from_numpy(pose), torch.from_numpy(inliers), rms_px, torch.from_numpy(covariance))
