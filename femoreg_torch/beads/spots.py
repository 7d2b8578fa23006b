"""Shadows of metal beads in a fluoroscopic image: found, and their centres measured to a fraction of a pixel.

A bead's attenuation is that of a sphere, 2 · √(r² − d²) along the ray at distance d from its centre, blurred by the
detector. Bone, and the edges of devices, lie behind it. So at every pixel the image within a round window is taken as a
quadratic surface plus some amount of that shadow (least squares, by convolutions), and kept where the shadow explains
most of what the surface leaves. The centres are then refined with the radius free and with weights that take away what
lies beside a surface and a shadow, such as the edge of a device (Tukey's biweight: Beaton and Tukey, Technometrics 16
(1974) 147).
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.errors import InputError

Array = NDArray[np.float64]

BLUR_PX = 0.9  # standard deviation of detector and pixel together, on pixels of 0.18 mm; on others see `blur_on`
_SCINTILLATOR_MM = 0.15  # standard deviation of the blur of a caesium iodide panel
_MARGIN_PX = 3.0  # of the window beside three radii of blur
_WINDOW_RADII = 2.0
_SEEN = 0.55  # least correlation of a window with the shadow, after the surface, for a candidate
_ROUND = 0.80  # the same after refinement, with the weights
_CONTRAST = 0.08  # least attenuation in the middle of a shadow: steel of 0.15 mm
_RADII = (0.7, 1.4)  # of the expected radius: depth and blur are not known exactly
_CANDIDATES = 80  # that are refined, best first
_ROUNDS = 4  # of new weights
_TUKEY = 4.685  # deviations beyond which a pixel counts nothing: 95 % efficiency for normal noise
_LEAST_SHARE = 0.5  # of the window's weight that must be left
_PROFILE_STEP = 0.05  # px, of the tabulated profile


@dataclass(frozen=True, eq=False)
class Spots:
    """Round shadows in one image, best first."""

    pixels: Tensor  # (N, 2) column, row
    radii_px: Tensor  # (N,)
    contrasts: Tensor  # (N,) attenuation in the middle
    scores: Tensor  # (N,) correlation with a sphere's shadow

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, which: Tensor) -> "Spots":
        """Those of an index or mask."""
        return Spots(*(values[which] for values in vars(self).values()))


def blur_on(pixel_mm: float) -> float:
    """Standard deviation, px, of a scintillator's blur and the average over a pixel of `pixel_mm` together."""
    return float(np.hypot(_SCINTILLATOR_MM / pixel_mm, 1 / np.sqrt(12)))


def shadow(radius_px: float, distance_px: Array, blur_px: float = BLUR_PX) -> Array:
    """Attenuation at distances from the centre of a sphere's shadow, 1 in the middle of the unblurred one.

    The shadow √(1 − (d / r)²) is blurred by a Gaussian, whose convolution is taken on a fine grid along one axis: the
    profile of a round shadow is the sum over lines of Gaussian samples.
    """
    reach = radius_px + 5 * blur_px
    step = max(_PROFILE_STEP, radius_px / 60)
    line = np.arange(0, reach + step, step)
    inside = np.arange(-radius_px, radius_px + step / 2, step)
    x, y = np.meshgrid(inside, inside)
    height = np.sqrt(np.clip(1 - (x**2 + y**2) / radius_px**2, 0, None))
    if blur_px == 0:
        return np.sqrt(np.clip(1 - (distance_px / radius_px) ** 2, 0, None))
    across = (height * np.exp(-(y**2) / (2 * blur_px**2))).sum(0) * step
    kernel = np.exp(-((line[:, None] - inside) ** 2) / (2 * blur_px**2)) * step / (2 * np.pi * blur_px**2)
    return np.interp(distance_px, line, kernel @ across, right=0.0)


def find_spots(attenuation: Tensor, radius_px: float, field: Tensor | None = None, blur_px: float = BLUR_PX) -> Spots:
    """Shadows of spheres whose radius is about `radius_px` in an attenuation image (H, W), bone bright.

    Only the exposed `field` (H, W), bool, is searched (None: all). Pixels count from the centre of the first one.
    Raises `InputError` for a radius that is no number of pixels a bead can have.
    """
    if not 0.8 <= radius_px <= 60:
        raise InputError(
            f"beads: a shadow of {radius_px:.2g} px radius was asked for, 0.8 to 60 were expected. Are bead diameters "
            "and the C-arm's pixels in mm?"
        )
    image = attenuation.double().numpy()
    amplitude, likeness = _matched(image, radius_px, blur_px)
    likeness[(amplitude < _CONTRAST)] = 0
    if field is not None:
        likeness[~field.numpy()] = 0
    size = 2 * round(radius_px) + 1
    peaks = (likeness >= _SEEN) & (likeness == ndimage.maximum_filter(likeness, size))
    rows, columns = np.nonzero(peaks)
    best = np.argsort(-likeness[rows, columns], kind="stable")[:_CANDIDATES]
    found = [_refined(image, columns[n], rows[n], radius_px, blur_px) for n in best]
    kept: list[Array] = []  # two candidates may end at one shadow
    for spot in sorted((s for s in found if s is not None), key=lambda s: -float(s[4])):
        if all(np.hypot(*(spot[:2] - other[:2])) > radius_px for other in kept):
            kept.append(spot)
    table = torch.from_numpy(np.array(kept).reshape(-1, 5))
    return Spots(table[:, :2], table[:, 2], table[:, 3], table[:, 4])


def window_px(radius_px: float, blur_px: float = BLUR_PX) -> int:
    """Radius of the window, whole pixels."""
    return int(np.ceil(_WINDOW_RADII * radius_px + 3 * blur_px / 2 + _MARGIN_PX))


def disc(half: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Columns and rows (n, n) from the middle, and which lie in the round window."""
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    return columns, rows, np.hypot(columns, rows) <= half + 0.5


def quadratic(columns: Array, rows: Array, half: float) -> Array:
    """A quadratic surface's six terms (N, 6) at pixels (N,)."""
    u, v = columns / half, rows / half
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1)


def _matched(image: Array, radius_px: float, blur_px: float) -> tuple[Array, Array]:
    """At every pixel: the amount of shadow beside a quadratic surface, and their correlation in the window."""
    half = window_px(radius_px, blur_px)
    columns, rows, inside = disc(half)
    basis, _ = np.linalg.qr(quadratic(columns[inside], rows[inside], half))
    expected = shadow(radius_px, np.hypot(columns, rows)[inside], blur_px)
    alone = expected - basis @ (basis.T @ expected)

    def filtered(values: Array, picture: Array) -> Array:
        kernel = np.zeros(inside.shape)
        kernel[inside] = values
        return np.asarray(cv2.filter2D(picture, cv2.CV_64F, kernel, borderType=cv2.BORDER_REFLECT))

    level = image - image.mean()  # squares of large numbers would cancel
    left = filtered(np.ones(inside.sum()), level**2) - sum(filtered(column, level) ** 2 for column in basis.T)
    hit = filtered(alone, level)
    norm = float((alone**2).sum())
    floor = 1e-9 * max(float(np.max(left)), 1e-30)
    return hit / norm, (hit / np.sqrt(np.maximum(left, floor) * norm)).clip(0, 1)


def _refined(image: Array, column: int, row: int, radius_px: float, blur_px: float) -> Array | None:
    """(column, row, radius, contrast, correlation) of the shadow near a pixel; None if there is none."""
    half = window_px(radius_px, blur_px)
    if not (half <= column < image.shape[1] - half and half <= row < image.shape[0] - half):
        return None
    columns, rows, inside = disc(half)
    u, v = columns[inside], rows[inside]
    values = image[row - half : row + half + 1, column - half : column + half + 1][inside]
    surface = quadratic(u, v, half)
    weights = np.ones(len(values))

    def solved(parameters: Array, weights: Array) -> tuple[Array, Array, Array]:
        """Residuals, the linear terms, and their columns."""
        bead = shadow(parameters[2], np.hypot(u - parameters[0], v - parameters[1]), blur_px)
        terms = np.column_stack([bead, surface])
        root = np.sqrt(weights)
        linear = np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0]
        return np.asarray(values - terms @ linear), np.asarray(linear), terms

    def weighted(parameters: Array, weights: Array) -> Array:
        return np.asarray(np.sqrt(weights) * solved(parameters, weights)[0])

    parameters = np.array([0.0, 0.0, radius_px])
    reach = ([-radius_px, -radius_px, 0.5 * radius_px], [radius_px, radius_px, 2.0 * radius_px])
    for _ in range(_ROUNDS):
        fit = least_squares(weighted, parameters, bounds=reach, x_scale=(0.1, 0.1, 0.1), xtol=1e-5, args=(weights,))
        parameters = fit.x
        residuals, linear, terms = solved(parameters, weights)
        scale = max(1.4826 * float(np.median(np.abs(residuals))), 1e-9)
        weights = np.clip(1 - (residuals / (_TUKEY * scale)) ** 2, 0, None) ** 2
    centre = np.hypot(u - parameters[0], v - parameters[1]) < parameters[2]
    if weights.mean() < _LEAST_SHARE or weights[centre].mean() < _LEAST_SHARE:
        return None
    score = _correlation(values, terms, weights)
    relative = parameters[2] / radius_px
    if linear[0] < _CONTRAST or score < _ROUND or not _RADII[0] < relative < _RADII[1]:
        return None
    return np.array([column + parameters[0], row + parameters[1], parameters[2], linear[0], score])


def _correlation(values: Array, terms: Array, weights: Array) -> float:
    """Weighted correlation of what a surface leaves of the window with what it leaves of the shadow (first term)."""
    root = np.sqrt(weights)
    basis, _ = np.linalg.qr(terms[:, 1:] * root[:, None])
    left, bead = values * root, terms[:, 0] * root
    left = left - basis @ (basis.T @ left)
    bead = bead - basis @ (basis.T @ bead)
    lengths = float(np.linalg.norm(left)) * float(np.linalg.norm(bead))
    return float(left @ bead) / max(lengths, 1e-30)
