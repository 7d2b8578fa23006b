"""Patch Grad-NCC on the CPU: compiled by numba, running sums, value and gradient, parallel over images."""

import numba as nb
import numpy as np
from numpy.typing import NDArray

_flags = {"contract", "reassoc", "nsz", "arcp"}
_jit = nb.njit(cache=True, fastmath=_flags, error_model="numpy")
_parallel = nb.njit(cache=True, fastmath=_flags, error_model="numpy", parallel=True, nogil=True)

Doubles = NDArray[np.float64]


@_jit
def _add(share, source, target):  # type: ignore[no-untyped-def]
    """Add share · source to target; rows of one length, as views, so that the loop is vectorised."""
    for x in range(len(target)):
        target[x] += share * source[x]


@_jit
def _row_filters(row, average, slope, averaged, sloped):  # type: ignore[no-untyped-def]
    """One row of an image filtered by both kernels; edges replicated."""
    width, reach = len(row), len(average) // 2
    averaged[:] = np.float32(0.0)
    sloped[:] = np.float32(0.0)
    for tap in range(2 * reach + 1):
        shift = tap - reach
        low, high = max(0, -shift), max(0, min(width, width - shift))
        seen = row[low + shift : high + shift]
        _add(average[tap], seen, averaged[low:high])
        _add(slope[tap], seen, sloped[low:high])
        for x in range(min(low, width)):
            averaged[x] += average[tap] * row[0]
            sloped[x] += slope[tap] * row[0]
        for x in range(high, width):
            averaged[x] += average[tap] * row[width - 1]
            sloped[x] += slope[tap] * row[width - 1]


@_jit
def _gradients(image, average, slope, out):  # type: ignore[no-untyped-def]
    """Derivatives (2, H, W) of an image (H, W), along columns then along rows."""
    height, width = image.shape
    reach = len(average) // 2
    averaged, sloped = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in range(height):
        _row_filters(image[y], average, slope, averaged[y], sloped[y])
    out[:] = np.float32(0.0)
    for y in range(height):
        for tap in range(2 * reach + 1):
            source = min(max(y + tap - reach, 0), height - 1)
            _add(average[tap], sloped[source], out[0, y])
            _add(slope[tap], averaged[source], out[1, y])


@_jit
def _add_transposed_gradients(maps, average, slope, out):  # type: ignore[no-untyped-def]
    """Adjoint of `_gradients`: add to `out` (H, W) what maps (2, H, W) send back."""
    height, width = out.shape
    reach = len(average) // 2
    averaged, sloped = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for y in range(height):
        for tap in range(2 * reach + 1):
            source = min(max(y + tap - reach, 0), height - 1)
            _add(average[tap], maps[0, y], sloped[source])
            _add(slope[tap], maps[1, y], averaged[source])
    for y in range(height):
        for tap in range(2 * reach + 1):
            shift = tap - reach
            low, high = max(0, -shift), max(0, min(width, width - shift))
            _add(average[tap], averaged[y][low:high], out[y][low + shift : high + shift])
            _add(slope[tap], sloped[y][low:high], out[y][low + shift : high + shift])
            for x in range(min(low, width)):
                out[y, 0] += average[tap] * averaged[y, x] + slope[tap] * sloped[y, x]
            for x in range(high, width):
                out[y, width - 1] += average[tap] * averaged[y, x] + slope[tap] * sloped[y, x]


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
                if not spread <= floor:  # nan stays nan
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


@_parallel
def grad_ncc_and_gradient(image, fixed, mean, scale, weights, radius, floor, average, slope):  # type: ignore[no-untyped-def]
    """Mean over both derivative maps of Σ weight · NCC of one image (H, W), and its gradient (H, W)."""
    height, width = image.shape
    side = 2 * radius + 1
    values, out = np.empty(2), np.zeros((height, width), np.float32)
    maps, back = np.empty((2, height, width), np.float32), np.empty((2, height, width), np.float32)
    _gradients(image, average, slope, maps)
    for d in nb.prange(2):
        store = np.empty((3, height - side + 1, width - side + 1))
        values[d] = _correlate(maps[d], fixed[d], mean[d], scale[d], weights, radius, floor, True, store)
        _spread_back(store, maps[d], fixed[d], radius, 0.5, back[d])
    _add_transposed_gradients(back, average, slope, out)
    return (values[0] + values[1]) / 2, out


# Curvature ------------------------------------------------------------------------------------------------------------
@_jit
def _box(image):  # type: ignore[no-untyped-def]
    """First and last + 1 row and column between which an image (H, W) is not zero; all 0 where it is nowhere."""
    height, width = image.shape
    of_column = np.zeros(width, np.float32)
    top, bottom = height, 0
    for y in range(height):
        of_row = np.float32(0.0)
        row = image[y]
        for x in range(width):
            size = abs(row[x])
            of_column[x] += size
            of_row += size
        if of_row > 0.0:
            top, bottom = min(top, y), y + 1
    if bottom == 0:
        return 0, 0, 0, 0
    left, right = width, 0
    for x in range(width):
        if of_column[x] > 0.0:
            left, right = min(left, x), x + 1
    return top, bottom, left, right


@_jit
def _patch_sums(one, other, side, stride, patches, plain, product):  # type: ignore[no-untyped-def]
    """Sums of `one` and of `one` · `other` over every stride-th patch.

    `patches` are their first and last + 1 row, then column.
    """
    first, last, low, high = patches
    left, right = low * stride, (high - 1) * stride + side
    column, column_product = np.empty(right - left, np.float32), np.empty(right - left, np.float32)
    for i in range(first, last):
        column[:] = np.float32(0.0)
        column_product[:] = np.float32(0.0)
        for y in range(i * stride, i * stride + side):
            a, b = one[y][left:right], other[y][left:right]
            for x in range(len(column)):
                column[x] += a[x]
                column_product[x] += a[x] * b[x]
        for j in range(high - low):
            total = total_product = np.float32(0.0)
            for x in range(j * stride, j * stride + side):
                total += column[x]
                total_product += column_product[x]
            plain[i, low + j] = total
            product[i, low + j] = total_product


@_jit
def _shares(moving, fixed, scale, weights, side, stride, floor, mean, of_mean, of_along, root):  # type: ignore[no-untyped-def]
    """What each patch weighs in the curvature, and the root of what all patches that hold a pixel weigh."""
    size = np.float32(side * side)
    rows, columns = mean.shape
    squares, fixed_mean, product = np.empty_like(mean), np.empty_like(mean), np.empty_like(mean)
    every = 0, rows, 0, columns
    _patch_sums(moving, moving, side, stride, every, mean, squares)
    _patch_sums(fixed, moving, side, stride, every, fixed_mean, product)
    all_weights = 0.0
    for i in range(rows):
        for j in range(columns):
            all_weights += weights[i * stride, j * stride]
    root[:] = np.float32(0.0)
    for i in range(rows):
        for j in range(columns):
            mean[i, j] /= size
            spread = max(squares[i, j] - size * mean[i, j] ** 2, floor)
            correlated = product[i, j] - mean[i, j] * fixed_mean[i, j]
            ncc = max(0.0, correlated * scale[i * stride, j * stride] / np.sqrt(spread))
            share = weights[i * stride, j * stride] / all_weights * ncc / spread if all_weights > 0.0 else 0.0
            of_mean[i, j] = np.sqrt(share / size)
            of_along[i, j] = np.sqrt(share / spread)
            if share > 0.0:
                for y in range(i * stride, i * stride + side):
                    covered = root[y][j * stride : j * stride + side]
                    for x in range(side):
                        covered[x] += np.float32(share)
    for y in range(root.shape[0]):
        row = root[y]
        for x in range(len(row)):
            row[x] = np.sqrt(row[x])


@_jit
def _factors(change, moving, mean, of_mean, of_along, root, side, stride, average, slope, maps, total, along):  # type: ignore[no-untyped-def]
    """What one change of the image gives to each of the three products that make up the curvature."""
    height, width = change.shape
    maps[:] = np.float32(0.0)
    total[:] = np.float32(0.0)
    along[:] = np.float32(0.0)
    top, bottom, left, right = _box(change)
    if bottom == 0:
        return
    reach = 2 * (len(average) // 2)  # twice, so that the edges are zeros, or those of the image
    top, bottom = max(0, top - reach), min(height, bottom + reach)
    left, right = max(0, left - reach), min(width, right + reach)
    found = np.empty((2, bottom - top, right - left), np.float32)
    _gradients(change[top:bottom, left:right].copy(), average, slope, found)
    rows, columns = total.shape[1], total.shape[2]
    first, last = max(0, -(-(top - side + 1) // stride)), min(rows, (bottom - 1) // stride + 1)
    low, high = max(0, -(-(left - side + 1) // stride)), min(columns, (right - 1) // stride + 1)
    for d in range(2):
        for y in range(bottom - top):
            _add(np.float32(1.0), found[d, y], maps[d, top + y][left:right])
        if last > first and high > low:
            _patch_sums(maps[d], moving[d], side, stride, (first, last, low, high), total[d], along[d])
            for i in range(first, last):
                for j in range(low, high):
                    along[d, i, j] = (along[d, i, j] - total[d, i, j] * mean[d, i, j]) * of_along[d, i, j]
                    total[d, i, j] *= of_mean[d, i, j]
        for y in range(top, bottom):
            row, weight = maps[d, y][left:right], root[d, y][left:right]
            for x in range(len(row)):
                row[x] *= weight[x]


@_parallel
def curvature_factors(  # type: ignore[no-untyped-def]
    image, changes, fixed, scale, weights, radius, stride, floor, average, slope
):
    """The curvature's three factors: F (n, 2, H, W), T and A (n, 2, patches), with curvature F Fᵀ − T Tᵀ − A Aᵀ.

    That is `patch_curvature` summed over both derivatives, for an image (H, W) and its changes (n, H, W).
    """
    count, height, width = changes.shape
    side = 2 * radius + 1
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    moving, root = np.empty((2, height, width), np.float32), np.empty((2, height, width), np.float32)
    shape = 2, rows, columns
    mean, of_mean, of_along = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
    _gradients(image, average, slope, moving)
    for d in nb.prange(2):
        _shares(moving[d], fixed[d], scale[d], weights, side, stride, floor, mean[d], of_mean[d], of_along[d], root[d])
    maps = np.empty((count, 2, height, width), np.float32)
    total, along = np.empty((count, 2, rows, columns), np.float32), np.empty((count, 2, rows, columns), np.float32)
    for c in nb.prange(count):
        _factors(
            changes[c], moving, mean, of_mean, of_along, root, side, stride, average, slope, maps[c], total[c], along[c]
        )
    return maps, total, along


@_parallel
def tile_sums(changes, slope, tile):  # type: ignore[no-untyped-def]
    """Sums (n, T) of changes (n, H, W) times slope (H, W) over square tiles, row by row of tiles."""
    count, height, width = changes.shape
    across = -(-width // tile)
    out = np.zeros((count, -(-height // tile) * across))
    for c in nb.prange(count):
        for y in range(height):
            change, rise = changes[c, y], slope[y]
            first = y // tile * across
            for t in range(across):
                total = np.float32(0.0)
                for x in range(t * tile, min(width, (t + 1) * tile)):
                    total += change[x] * rise[x]
                out[c, first + t] += total
    return out
