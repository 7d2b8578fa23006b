"""Beads, a camera, and images of beads over bone-like clutter, all from analytic formulas."""

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.geometry import Camera, about_point, centred_camera, exp_se3, project_points, rigid, transform_points

CAMERA = centred_camera(1020.0, (0.194, 0.194), (1536, 1536))
FEMUR = torch.tensor(
    [[2, 1, 3], [-9, 6, 8], [7, -10, -4], [-3, 9, -11], [38, 5, -30], [45, -7, -22], [50, 8, -41]], dtype=torch.float64
)
DEVICE = torch.tensor([[12, 3, 20], [-8, 11, 35], [30, -6, 55], [44, 9, 30], [3, -12, 70]], dtype=torch.float64)


def pose(twist: tuple[float, ...], depth_mm: float, points: Tensor) -> Tensor:
    """`camera_from_object` (4, 4): the AP view of an object turned about its beads by a twist (rad, mm)."""
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    middle = points.mean(0)
    ap = rigid(turn, torch.tensor([0, 0, depth_mm], dtype=torch.float64) - turn @ middle)
    centre = transform_points(ap, middle[None])[0]
    return about_point(exp_se3(torch.tensor(twist, dtype=torch.float64)), centre) @ ap


def seen(points: Tensor, camera_from_object: Tensor, camera: Camera = CAMERA) -> Tensor:
    """Pixels (N, 2) of points."""
    return project_points(camera, transform_points(camera_from_object, points))


def disc_image(
    centres: Tensor, radius_px: float, shape: tuple[int, int], contrast: float, noise: float, seed: int
) -> Tensor:
    """An attenuation image of spheres' shadows over bone edges and a metal bar, blurred as a detector does.

    The shadows are cut into 8 × 8 parts a pixel, so they share no code with the profile that is fitted to them.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    image = 3.0 + 0.002 * columns + 0.4 * (columns + 0.3 * rows > 0.6 * shape[1])  # a cortex
    image += 0.3 * np.exp(-((rows - 0.4 * shape[0] - 0.1 * columns) ** 2) / 60)  # a rim
    image += 1.5 * (rows > 0.85 * shape[0])  # the edge of a metal bar
    image += ndimage.gaussian_filter(rng.normal(0, 1, shape), 6) * 0.6  # trabeculae
    parts = (np.arange(8) + 0.5) / 8 - 0.5
    half = int(radius_px) + 3
    for column, row in centres.tolist():
        left, top = round(column) - half, round(row) - half
        u = (np.arange(left, left + 2 * half + 1)[:, None] + parts).ravel() - column
        v = (np.arange(top, top + 2 * half + 1)[:, None] + parts).ravel() - row
        height = np.sqrt(np.clip(1 - (u[None] ** 2 + v[:, None] ** 2) / radius_px**2, 0, None))
        mean = height.reshape(2 * half + 1, 8, 2 * half + 1, 8).mean((1, 3))
        image[top : top + 2 * half + 1, left : left + 2 * half + 1] += contrast * mean
    image = ndimage.gaussian_filter(image, 0.8)
    return torch.from_numpy((image + rng.normal(0, noise, shape)).astype(np.float32))
