"""Patch Grad-NCC on the CPU: compiled by numba, running sums, value and gradient, parallel over images."""

import numba as nb
import numpy as np
from numpy.typing import NDArray

_flags = {"contract", "reassoc", "nsz", "arcp"}
_jit = nb.njit(cache=True, fastmath=_flags, error_model="numpy")
_parallel = nb.njit(cache=True, fastmath=_flags, error_model="numpy", parallel=True)

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@_jit
def _row_filters(image, y, average, slope, averaged, sloped):  # type: ignore[no-untyped-def]
    """One row of the image filtered along the row by both kernels; edges replicated."""
    width, reach = image.shape[1], len(average) // 2
    for x in range(width):
        averaged[x] = np.float32(0.0)
        sloped[x] = np.float32(0.0)
    for tap in range(2 * reach + 1):
        shift = tap - reach
        a, s = average[tap], slope[tap]
        low, high = max(0, -shift), min(width, width - shift)
        for x in range(low, high):
            averaged[x] += a * image[y, x + shift]
            sloped[x] += s * image[y, x + shift]
        for x in range(low):
            averaged[x] += a * image[y, 0]
            sloped[x] += s * image[y, 0]
        for x in range(high, width):
            averaged[x] += a * image[y, width - 1]
            sloped[x] += s * image[y, width - 1]


@_jit
def _gradients(image, average, slope, out):  # type: ignore[no-untyped-def]
    """Derivatives (2, H, W) of an image (H, W), along columns then along rows."""
    height, width = image.shape
    reach = len(average) // 2
    averaged, sloped = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in range(height):
        _row_filters(image, y, average, slope, averaged[y], sloped[y])
    out[:] = np.float32(0.0)
    for y in range(height):
        for tap in range(2 * reach + 1):
            source = min(max(y + tap - reach, 0), height - 1)
            a, s = average[tap], slope[tap]
            for x in range(width):
                out[0, y, x] += a * sloped[source, x]
                out[1, y, x] += s * averaged[source, x]


@_jit
def _add_transposed_gradients(maps, average, slope, out):  # type: ignore[no-untyped-def]
    """Adjoint of `_gradients`: add to `out` (H, W) what maps (2, H, W) send back."""
    height, width = out.shape
    reach = len(average) // 2
    averaged, sloped = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for y in range(height):
        for tap in range(2 * reach + 1):
            source = min(max(y + tap - reach, 0), height - 1)
            a, s = average[tap], slope[tap]
            for x in range(width):
                sloped[source, x] += a * maps[0, y, x]
                averaged[source, x] += s * maps[1, y, x]
    for y in range(height):
        for tap in range(2 * reach + 1):
            shift = tap - reach
            a, s = average[tap], slope[tap]
            low, high = max(0, -shift), min(width, width - shift)
            for x in range(low, high):
                out[y, x + shift] += a * averaged[y, x] + s * sloped[y, x]
            for x in range(low):
                out[y, 0] += a * averaged[y, x] + s * sloped[y, x]
            for x in range(high, width):
                out[y, width - 1] += a * averaged[y, x] + s * sloped[y, x]


@_jit
def _correlate(moving, fixed, mean, scale, weights, radius, floor, keep, store):  # type: ignore[no-untyped-def]
    """Σ weight · NCC over all patches of one derivative map; with `keep`, also what its gradient needs in `store`.

    `mean` and `scale` are the fixed patches' mean and 1 / √Σ(f − mean)² (0 where flat). `store` is (3, H − 2r, W − 2r).
    """
    height, width = moving.shape
    side = 2 * radius + 1
    inverse = 1.0 / (side * side)
    column_m, column_mm, column_mf = np.zeros(width), np.zeros(width), np.zeros(width)
    total = 0.0
    for y in range(height):
        for x in range(width):
            m, f = np.float64(moving[y, x]), np.float64(fixed[y, x])
            column_m[x] += m
            column_mm[x] += m * m
            column_mf[x] += m * f
        if y >= side:
            for x in range(width):
                m, f = np.float64(moving[y - side, x]), np.float64(fixed[y - side, x])
                column_m[x] -= m
                column_mm[x] -= m * m
                column_mf[x] -= m * f
        top = y - side + 1
        if top >= 0:
            sm = smm = smf = 0.0
            for x in range(side - 1):
                sm += column_m[x]
                smm += column_mm[x]
                smf += column_mf[x]
            for left in range(width - side + 1):
                sm += column_m[left + side - 1]
                smm += column_mm[left + side - 1]
                smf += column_mf[left + side - 1]
                spread = smm - sm * sm * inverse
                product = a = b = 0.0
                if spread > floor:
                    a = scale[top, left] / np.sqrt(spread)
                    product = (smf - sm * mean[top, left]) * a
                    b = product / spread
                total += weights[top, left] * product
                if keep:
                    w = weights[top, left]
                    store[0, top, left] = w * a
                    store[1, top, left] = w * b
                    store[2, top, left] = w * (a * mean[top, left] - b * sm * inverse)
                sm -= column_m[left]
                smm -= column_mm[left]
                smf -= column_mf[left]
    return total


@_jit
def _spread_back(store, moving, fixed, radius, share, out):  # type: ignore[no-untyped-def]
    """Gradient of Σ weight · NCC with respect to the moving map, times `share`, into `out` (H, W).

    For every pixel: f · ΣA − m · ΣB − ΣC over the patches that hold it, with A, B, C from `_correlate`.
    """
    height, width = moving.shape
    side = 2 * radius + 1
    rows, columns = height - side + 1, width - side + 1
    column = np.zeros((3, columns))
    for y in range(height):
        if y < rows:
            for c in range(3):
                for x in range(columns):
                    column[c, x] += store[c, y, x]
        if y >= side:
            for c in range(3):
                for x in range(columns):
                    column[c, x] -= store[c, y - side, x]
        a = b = c0 = 0.0
        for x in range(width):
            if x < columns:
                a += column[0, x]
                b += column[1, x]
                c0 += column[2, x]
            if x >= side:
                a -= column[0, x - side]
                b -= column[1, x - side]
                c0 -= column[2, x - side]
            out[y, x] = np.float32(share * (fixed[y, x] * a - moving[y, x] * b - c0))


@_parallel
def gradients(images, average, slope):  # type: ignore[no-untyped-def]
    """Derivatives (B, 2, H, W) of images (B, H, W), along columns then along rows."""
    count, height, width = images.shape
    out = np.empty((count, 2, height, width), np.float32)
    for i in nb.prange(count):
        _gradients(images[i], average, slope, out[i])
    return out


@_parallel
def grad_ncc(images, fixed, mean, scale, weights, radius, floor, average, slope):  # type: ignore[no-untyped-def]
    """Σ weight · NCC (B, 2) of the derivative maps of images (B, H, W) with the fixed ones (2, H, W)."""
    count, height, width = images.shape
    out = np.empty((count, 2))
    none = np.empty((3, 1, 1))
    for i in nb.prange(count):
        maps = np.empty((2, height, width), np.float32)
        _gradients(images[i], average, slope, maps)
        for d in range(2):
            out[i, d] = _correlate(maps[d], fixed[d], mean[d], scale[d], weights, radius, floor, False, none)
    return out


@_parallel
def grad_ncc_gradient(  # type: ignore[no-untyped-def]
    images, fixed, mean, scale, weights, radius, floor, average, slope, upstream
):
    """Gradient (B, H, W) of Σ_b upstream_b · Σ weight · NCC / 2 over both derivative maps by the images."""
    count, height, width = images.shape
    side = 2 * radius + 1
    out = np.zeros((count, height, width), np.float32)
    back = np.empty((count, 2, height, width), np.float32)
    for task in nb.prange(2 * count):
        i, d = task // 2, task % 2
        maps = np.empty((2, height, width), np.float32)
        _gradients(images[i], average, slope, maps)
        store = np.empty((3, height - side + 1, width - side + 1))
        _correlate(maps[d], fixed[d], mean[d], scale[d], weights, radius, floor, True, store)
        _spread_back(store, maps[d], fixed[d], radius, 0.5 * upstream[i], back[i, d])
    for i in nb.prange(count):
        _add_transposed_gradients(back[i], average, slope, out[i])
    return out
