"""Gaussian blur of volumes, compiled and on all cores. The result does not depend on how many there are."""

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def gaussian_filter(
    values: Array,
    sigma: float | Sequence[float] | NDArray[np.floating[Any]],
    truncate: float = 4.0,
    out: Array | None = None,
) -> Array:
    """A volume (A, B, C) blurred by a Gaussian of `sigma` voxels, one for all axes or one each; the border is mirrored.

    That of `scipy.ndimage.gaussian_filter`, in float32 throughout: the kernel ends `truncate` deviations from its
    middle. `out` takes the result, and may be `values` itself.
    """
    widths = [sigma] * 3 if isinstance(sigma, int | float) else list(sigma)
    first, second, third = (_kernel(float(width), truncate) for width in widths)
    if out is None:
        out = np.empty(values.shape, np.float32)
    _within_planes(values, second, third, out)
    if len(first) > 1:
        _across_planes(out, first)
    return out


def _kernel(sigma: float, truncate: float) -> Array:
    """The middle of the kernel and its one half."""
    at = np.arange(int(truncate * sigma + 0.5) + 1)
    weights = np.exp(-0.5 * (at / max(sigma, 1e-6)) ** 2)
    return (weights / (2 * weights.sum() - weights[0])).astype(np.float32)


@nb.njit(cache=True)
def _mirrored(index, size):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    index %= 2 * size
    return index if index < size else 2 * size - 1 - index


@nb.njit(cache=True, parallel=True)
def _within_planes(values, second, third, out):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Blur along the last two axes."""
    rows, columns = values.shape[1:]
    beyond = len(third) - 1
    for a in nb.prange(values.shape[0]):
        plane = np.empty((rows, columns), np.float32)
        line = np.empty(columns + 2 * beyond, np.float32)
        for b in range(rows):
            for c in range(beyond):
                line[c] = values[a, b, _mirrored(c - beyond, columns)]
                line[beyond + columns + c] = values[a, b, _mirrored(columns + c, columns)]
            line[beyond : beyond + columns] = values[a, b]
            row = plane[b]
            for c in range(columns):
                row[c] = third[0] * line[beyond + c]
            for t in range(1, beyond + 1):
                for c in range(columns):
                    row[c] += third[t] * (line[beyond + c - t] + line[beyond + c + t])
        for b in range(rows):
            _weighted(plane, b, second, out[a, b])


@nb.njit(cache=True, parallel=True)
def _across_planes(values, first):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Blur along the first axis, in place."""
    for b in nb.prange(values.shape[1]):
        plane = values[:, b].copy()
        for a in range(values.shape[0]):
            _weighted(plane, a, first, values[a, b])


@nb.njit(cache=True)
def _weighted(plane, middle, kernel, row):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Set `row` to the weighted sum of the plane's rows about the middle one."""
    for c in range(len(row)):
        row[c] = kernel[0] * plane[middle, c]
    for t in range(1, len(kernel)):
        before, after = plane[_mirrored(middle - t, len(plane))], plane[_mirrored(middle + t, len(plane))]
        for c in range(len(row)):
            row[c] += kernel[t] * (before[c] + after[c])
