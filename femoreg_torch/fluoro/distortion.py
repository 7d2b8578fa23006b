"""Distortion of an image intensifier, from an image of a grid of balls or holes on its face.

Its curved input screen stretches the picture towards the rim, and the earth's magnetic field turns it, differently for
every pose of the C-arm: each view has a grid image of its own. Where each spot of the grid is seen, against where a
straight camera with the C-arm's pixels would see it, fixes a polynomial of two variables (Fahrig et al., Med Phys 24,
1997, 1097). How the grid lies on the face is not known, so a shift and a turn of the whole picture stay open; they are
chosen so that the spots move least.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro.collimation import exposed_field
from femoreg_torch.geometry import Camera

_DEGREES = (5, 3)  # of the polynomial: the first one that has spots enough
_SPOTS_PER_TERM = 2
_NEAR = 0.3  # of the pitch: how far a spot may lie from where its neighbours lead
_MOST_RESIDUAL = 0.05  # of the pitch, root mean square
_PITCHES = (0.5, 2.0)  # the seen pitch in the middle, as a share of the told one

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GridImage:
    """The image of a grid on the detector's face."""

    path: Path
    pitch_mm: float  # between neighbours


@dataclass(frozen=True, eq=False)
class Distortion:
    """Where a straight picture's pixels are found in the picture as it is stored."""

    shape: tuple[int, int]
    degree: int
    terms: Array  # (N, 2) of the polynomial: column and row offsets, px
    spots: int
    residual_mm: float  # root mean square of the spots from the polynomial, on the detector
    greatest_mm: float  # by which a spot is moved

    def bent(self, pixels: Array) -> Array:
        """Places (..., 2), column and row, of a straight picture as places in the stored one."""
        return np.asarray(pixels + _terms(pixels, self.shape, self.degree) @ self.terms)

    def straight(self, pixels: Tensor) -> Tensor:
        """Places (..., 2) in the stored picture as places in the straight one: the inverse of `bent`."""
        seen = pixels.double().numpy()
        found = seen.copy()
        for _ in range(50):  # a contraction, as offsets change by a tenth of a pixel per pixel at most
            found = found + seen - self.bent(found)
        return torch.from_numpy(found)

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        rows, columns = np.indices(self.shape, dtype=np.float64)
        places = self.bent(np.stack([columns, rows], -1)).astype(np.float32)
        return np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])

    def straightened(self, image: Tensor) -> Tensor:
        """A stored picture (H, W), interpolated, or a mask, bool, made straight; the border is repeated beyond it."""
        is_mask = image.dtype == torch.bool
        how = cv2.INTER_NEAREST if is_mask else cv2.INTER_LINEAR
        found = cv2.remap(image.float().numpy(), *self._maps, how, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(found) > 0.5 if is_mask else torch.from_numpy(found)


def find_distortion(grid: Tensor, camera: Camera, pitch_mm: float, where: str) -> Distortion:
    """The distortion of pictures of `camera`, from the raw image (H, W) of a square grid.

    Spots are looked for where the detector is exposed, within the black ring of an image intensifier. Raises
    `InputError` that starts with `where` if no grid of this pitch is seen, with too few spots, or not as one.
    """
    seen = find_grid_spots(grid, exposed_field(grid, camera))
    mm = np.array([camera.pixel_mm[1], camera.pixel_mm[0]])
    index = _indices(seen * mm, pitch_mm, where)
    known = np.isfinite(index[:, 0])
    index, seen = index[known], seen[known]
    degree = next((d for d in _DEGREES if len(seen) >= _SPOTS_PER_TERM * _count(d)), None)
    if degree is None:
        raise InputError(f"{where}: only {len(seen)} spots of the grid are seen. Take a whole image of the grid.")
    straight = _laid(index * pitch_mm, seen * mm) / mm
    terms, *_ = np.linalg.lstsq(_terms(straight, camera.shape, degree), seen - straight, rcond=None)
    off = (straight + _terms(straight, camera.shape, degree) @ terms - seen) * mm
    residual = float(np.sqrt((off**2).sum(1).mean()))
    if residual > _MOST_RESIDUAL * pitch_mm:
        raise InputError(
            f"{where}: the spots lie {residual:.1f} mm from a smooth grid. Is it square, and all of it seen?"
        )
    greatest = float(np.linalg.norm((seen - straight) * mm, axis=1).max())
    return Distortion(camera.shape, degree, terms, len(seen), residual, greatest)


def find_grid_spots(grid: Tensor, field: Tensor | None = None) -> Array:
    """Middles (N, 2), column and row, of the small spots in an image, all darker or all brighter than around them.

    Only the exposed `field` (H, W), bool, counts (None: all): what lies outside it, the black ring of an image
    intensifier say, is nearly nothing, whose logarithm would swamp that of the spots. Spots that its edge cuts are left
    out, as their middles are not to be seen.
    """
    inside = np.ones(grid.shape, bool) if field is None else field.numpy()
    raw = grid.double().numpy()
    image = np.log(np.maximum(raw, 1e-6 * float(raw[inside].max())))
    if field is not None:  # each pixel outside as the nearest one inside, so that the edge is none
        image = image[tuple(ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True))]
    scale = 255 / max(float(np.ptp(image)), 1e-12)
    small = ((image - image.min()) * scale).astype(np.uint8)
    width = 2 * (max(image.shape) // 60) + 3  # wider than a ball, narrower than the pitch
    around = cv2.medianBlur(small, width).astype(np.float64) / scale + image.min()
    response = cv2.GaussianBlur(image - around, (0, 0), 1.0)
    low, high = np.quantile(response[inside], [0.001, 0.999])
    response, level = (response, 0.5 * high) if high > -low else (-response, -0.5 * low)
    spots = ((response > level) & inside).astype(np.uint8)
    _, parts, counts, middles = cv2.connectedComponentsWithStats(spots)
    areas = counts[1:, cv2.CC_STAT_AREA]
    usual = np.median(areas) if len(areas) else 0
    whole = ~np.isin(np.arange(1, len(counts)), parts[ndimage.binary_dilation(~inside)])
    kept = 1 + np.flatnonzero((areas > 0.3 * usual) & (areas < 3 * usual) & whole)
    rows, columns = np.indices(image.shape)
    weight = np.where(np.isin(parts, kept), response.clip(0), 0.0)
    total = np.bincount(parts.ravel(), weight.ravel(), minlength=len(middles))[kept]
    sums = [
        np.bincount(parts.ravel(), (weight * place).ravel(), minlength=len(middles))[kept] for place in (columns, rows)
    ]
    return np.stack(sums, 1) / total[:, None]


def _indices(places_mm: Array, pitch_mm: float, where: str) -> Array:
    """Whole numbers (N, 2) of the spots (N, 2) along the two directions of the grid; nan for what is none of it.

    They spread from the spot in the middle, each by where its neighbours lead, so that the grid may bend.
    """
    found = np.full(places_mm.shape, np.nan)
    if len(places_mm) < 5:
        raise InputError(f"{where}: {len(places_mm)} spots are seen, a grid was expected.")
    tree = cKDTree(places_mm)
    first = int(np.linalg.norm(places_mm - np.median(places_mm, 0), axis=1).argmin())
    apart, near = tree.query(places_mm[first], 5)
    pitch = float(np.median(apart[1:]))
    if not _PITCHES[0] * pitch_mm < pitch < _PITCHES[1] * pitch_mm:
        raise InputError(
            f"{where}: neighbours lie {pitch:.1f} mm apart on the detector, but a pitch of {pitch_mm:g} mm is told. "
            "Correct `pitch_mm`, or `pixel_mm` of the C-arm."
        )
    steps = places_mm[near[1:]] - places_mm[first]
    right = steps[steps[:, 0].argmax()]
    down = np.array([-right[1], right[0]])
    found[first] = 0
    local = {first: np.stack([right, down])}
    waiting = [first]
    while waiting:
        spot = waiting.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            guess = places_mm[spot] + sign * local[spot][axis]
            away, other = tree.query(guess)
            if away > _NEAR * pitch or np.isfinite(found[other, 0]):
                continue
            found[other] = found[spot] + sign * np.eye(2)[axis]
            step = sign * (places_mm[other] - places_mm[spot])
            across = np.array([-step[1], step[0]]) if axis == 0 else np.array([step[1], -step[0]])
            local[other] = np.stack([step, across] if axis == 0 else [across, step])
            waiting.append(int(other))
    return found


def _laid(grid: Array, seen: Array) -> Array:
    """The points of a straight grid (N, 2) shifted and turned to lie as near as can be to where they are seen, mm."""
    middle, centre = grid.mean(0), seen.mean(0)
    u, _, v = np.linalg.svd((grid - middle).T @ (seen - centre))
    turn = u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v
    return np.asarray((grid - middle) @ turn + centre)


def _count(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


def _terms(pixels: Array, shape: tuple[int, int], degree: int) -> Array:
    """Products of powers (..., K) of places in shares of half the picture's size from its middle."""
    half = (max(shape) - 1) / 2
    x, y = (pixels[..., 0] - (shape[1] - 1) / 2) / half, (pixels[..., 1] - (shape[0] - 1) / 2) / half
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], -1)
