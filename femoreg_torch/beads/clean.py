"""Beads taken out of images and of the CT, so that a registration does not see them.

A registration that sees beads is helped by what no patient has. So the disc of each shadow, and the ball of each bead
in the CT, is filled from what lies around it. Nothing is masked: a patch of a similarity that touches a mask counts
nothing, and seven of them would take away most of the femoral head.
"""

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.volume import Volume

_BLUR_MM = 0.55  # on the detector, around a shadow: 3 deviations of a scintillator's blur and a pixel's half
_CT_MARGIN_MM = 1.75  # around a bead in the CT: 3 deviations of a scanner's blur
_FILL_MM = 1.5  # width of the average that fills the CT


def image_without(image: Tensor, centres: Tensor, radii_px: Tensor, camera: Camera) -> Tensor:
    """An image (H, W) whose discs about `centres` (N, 2) (column, row) are filled from around.

    By the Navier–Stokes inpainting of OpenCV (Bertalmio, Bertozzi and Sapiro, CVPR 2001).
    """
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    mask = np.zeros(image.shape, np.uint8)
    reach = radii_px.numpy() + _BLUR_MM / camera.mean_pixel_mm
    for (column, row), radius in zip(centres.tolist(), reach.tolist(), strict=True):
        low, high = max(0, int(row - radius) - 1), int(row + radius) + 2
        left, right = max(0, int(column - radius) - 1), int(column + radius) + 2
        window = (slice(low, high), slice(left, right))
        mask[window][np.hypot(columns[window] - column, rows[window] - row) <= radius] = 1
    whole = image.float().numpy()
    return torch.from_numpy(cv2.inpaint(np.ascontiguousarray(whole), mask, 3, cv2.INPAINT_NS))


def shadows_of(points: Tensor, diameter_mm: float, camera_from_object: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Where beads (N, 3) are drawn, (N, 2) pixels, and the radii (N,) of their shadows in pixels."""
    places = transform_points(camera_from_object, points)
    radii = diameter_mm / 2 * camera.sdd_mm / places[:, 2] / camera.mean_pixel_mm
    return project_points(camera, places), radii


def ct_without(ct: Volume, points: Tensor, diameter_mm: float) -> Volume:
    """A CT in HU whose balls about beads (N, 3), LPS mm, are filled by averages of what is around them."""
    data = ct.data.clone()
    index_from_lps = torch.linalg.inv(ct.lps_from_index)
    spacing = np.array(ct.spacing_mm)
    reach = diameter_mm / 2 + _CT_MARGIN_MM
    half = np.ceil((reach + 3 * _FILL_MM) / spacing).astype(int)
    for point in points:
        index = transform_points(index_from_lps, point[None])[0].numpy()
        middle = np.round(index).astype(int)
        low = np.clip(middle - half, 0, None)
        high = np.minimum(middle + half + 1, np.array(data.shape[::-1]))
        window = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
        part = data[window].numpy().astype(np.float64)
        z, y, x = np.mgrid[window]
        places = np.stack([x, y, z], -1)
        inside = np.linalg.norm((places - index) * spacing, axis=-1) <= reach
        sigma = _FILL_MM / spacing[::-1]
        share = ndimage.gaussian_filter((~inside).astype(float), sigma, mode="nearest")
        fill = ndimage.gaussian_filter(np.where(inside, 0, part), sigma, mode="nearest") / np.maximum(share, 1e-9)
        data[window] = torch.from_numpy(np.where(inside, fill, part)).to(data.dtype)
    return ct.with_data(data)
