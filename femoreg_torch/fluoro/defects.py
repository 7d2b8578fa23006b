"""Pixels and lines of a detector that are dead, or stuck at some value, taken from their neighbours.

Makers correct them before an image is shown; raw images may still hold them. A block average spreads each over its
block, and a line is an edge that no object has: a few thousand pixels and four lines turned a femur by 1.5°.
"""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter
from torch import Tensor

_WIDE_PX = 9  # lines: a row or column is compared with the median of so many; up to four lines side by side are found
_LINE_OFF = 0.15  # of what a line's middle value should be; a straight edge of an object leaves no such line
_SURE = 10.0  # robust standard deviations, of pixels about as bright, that a pixel is off
_OFF = 0.3  # and share of what it should be
_MOST_PIXELS = 3  # side by side: a thin wire, a bead or a letter has more
_FEW = 2e-4  # share of pixels that is left as it is: corners of thin wires
_LEVELS = 24  # of brightness, each with a noise of its own
_SPARSE = 4  # every so many-th pixel tells a line's middle, and every so many-th line the noise
_MOST = 0.9  # of the pixels of a level,
_DEVIATIONS = 1.645  # which lie within so many standard deviations of a normal distribution
_QUARTERS = (0.25, 0.5, 0.75)  # of a line that must all stand out: letters fill less
_FINEST_MM = 0.5  # of coarser pixels a bead or a wire may fill no more than a few

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


def without_defects(image: Tensor, raw: Tensor, pixel_mm: float) -> tuple[Tensor, str | None]:
    """An image (H, W) without the dead and stuck pixels and lines of its detector, and what was mended, in words.

    `raw` are its intensities, by which they are found; `image` holds the same or their logarithms. Pixels are taken
    from the median of 5 × 5 about them, lines from those beside them. None where nothing was found. Single pixels are
    not looked for where they are larger than 0.5 mm.
    """
    values, light = image.float().numpy(), raw.float().numpy()
    rows, columns = _lines(light), _lines(light.T)
    if rows.any() or columns.any():
        values, light = (_filled(_filled(each, rows).T, columns).T for each in (values, light))
    dead = _pixels(light) if pixel_mm <= _FINEST_MM else np.zeros(light.shape, bool)
    lines, count = int(rows.sum() + columns.sum()), int(dead.sum())
    if not lines and count < _FEW * dead.size:
        return image, None
    if count:
        values = np.where(dead, cv2.medianBlur(np.ascontiguousarray(values), 5), values)
    told = [f"{count} pixel{'s' * (count != 1)}"] * bool(count) + [f"{lines} line{'s' * (lines != 1)}"] * bool(lines)
    return (
        torch.from_numpy(np.ascontiguousarray(values)).to(image.dtype),
        f"has {' and '.join(told)} that the detector did not measure, by their looks; they were taken from what lies "
        "beside them",
    )


def _lines(light: Array) -> Mask:
    """Rows (H,) of an image that stand out from those beside them as a whole."""
    profiles = np.quantile(light[:, ::_SPARSE], _QUARTERS, axis=1)
    expected = median_filter(profiles, (1, _WIDE_PX), mode="nearest")
    off = profiles - expected
    usual = np.quantile(np.abs(off), _MOST, axis=1, keepdims=True) / _DEVIATIONS
    least = np.maximum(_LINE_OFF * expected, _SURE * usual + _step(light[::_SPARSE, ::_SPARSE]))
    return (off > least).all(0) | (off < -least).all(0)


def _step(light: Array) -> float:
    """The least step of the grey values; infinite of a constant image."""
    return float(np.diff(np.unique(light)).min(initial=np.inf))


def _filled(image: Array, rows: Mask) -> Array:
    """The image (H, W) with some rows linear between those above and below."""
    if not rows.any():
        return image
    good, bad = np.flatnonzero(~rows), np.flatnonzero(rows)
    after = np.searchsorted(good, bad).clip(1, len(good) - 1)
    low, high = good[after - 1], good[after]
    share = ((bad - low) / (high - low)).clip(0, 1).astype(np.float32)[:, None]
    filled = image.copy()
    filled[bad] = (1 - share) * image[low] + share * image[high]
    return filled


def _pixels(light: Array) -> Mask:
    """Pixels (H, W) that are far from the middle of those about them, alone or in threes at most."""
    expected: Array = cv2.medianBlur(np.ascontiguousarray(light), 5).astype(np.float32, copy=False)
    off: Array = np.abs(light - expected)
    far = off > _OFF * expected
    far[far] = off[far] > _SURE * _noise(expected, off, expected[far])
    if not far.any():
        return far
    _, numbers, about, _ = cv2.connectedComponentsWithStats(far.astype(np.uint8), connectivity=8)
    small: Mask = about[:, cv2.CC_STAT_AREA] <= _MOST_PIXELS
    return far & small[numbers]


def _noise(expected: Array, off: Array, asked: Array) -> Array:
    """Standard deviation (N,) of pixels as bright as is `asked` (N,) about their middle values.

    At least a step of the grey values.
    """
    some, apart = expected[::_SPARSE, ::_SPARSE].ravel(), off[::_SPARSE, ::_SPARSE].ravel()
    edges = np.unique(np.quantile(some, np.linspace(0, 1, _LEVELS + 1)[1:-1]))
    level = np.searchsorted(edges, some)
    within = [np.quantile(apart[level == n], _MOST) if (level == n).any() else 0.0 for n in range(len(edges) + 1)]
    noise = maximum_filter1d(np.array(within, np.float32) / _DEVIATIONS, 3)  # a level that is cut off has none
    return np.maximum(noise, _step(some))[np.searchsorted(edges, asked)]
