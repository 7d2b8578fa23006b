# mypy: disable-error-code="no-untyped-def"
"""Patch Grad-NCC in Triton. Importing this module imports Triton; only `cuda.py` does, and only when needed.

What `cpu.py` does, one pixel or patch per lane: each adds up what it needs, as a GPU's caches make that cheaper than
running sums. Sums over patches are float64, so that flat regions stay exact. No atomics: two runs agree bit for bit.

Tensors, all contiguous: `images` (B, H, W) and `maps` (B, 2, H, W), derivatives along columns then along rows, float32;
`fixed` (2, H, W), `mean` and `scale` (2, H − 2r, W − 2r), `weights` (H − 2r, W − 2r) as in `FixedGradNcc`; `taps`
(2, 3, K) float32: the kernel that averages, then that which differentiates, each as it is inside an image and, summed
up from either end, at its first and last row or column, where the edge's pixel stands for all beyond it.
"""

import triton
import triton.language as tl

# Compiled once for all sizes, as the projector's kernels.
_SIZES = ["height", "width", "rows", "columns", "radius", "stride", "tile", "across"]
_kernel = triton.jit(do_not_specialize=_SIZES)


@triton.jit
def _lanes(rows, columns, block: tl.constexpr):
    """Place, row and column of this program's pixels or patches, and whether there are such."""
    place = tl.program_id(0) * block + tl.arange(0, block)
    return place, place // columns, place % columns, place < rows * columns


@_kernel
def derivatives(images, taps, height, width, maps, count: tl.constexpr, block: tl.constexpr):
    """Derivatives `maps` (B, 2, H, W) of images; `count` is K."""
    place, row, column, on = _lanes(height, width, block)
    image = images + tl.program_id(1).to(tl.int64) * height * width
    along_columns = tl.zeros([block], tl.float32)
    along_rows = tl.zeros([block], tl.float32)
    for i in range(count):
        line = image + tl.minimum(tl.maximum(row + i - count // 2, 0), height - 1) * width
        averaged = tl.zeros([block], tl.float32)
        sloped = tl.zeros([block], tl.float32)
        for j in range(count):
            value = tl.load(line + tl.minimum(tl.maximum(column + j - count // 2, 0), width - 1), mask=on, other=0.0)
            averaged += tl.load(taps + j) * value
            sloped += tl.load(taps + 3 * count + j) * value
        along_columns += tl.load(taps + i) * sloped
        along_rows += tl.load(taps + 3 * count + i) * averaged
    out = maps + tl.program_id(1).to(tl.int64) * 2 * height * width + place
    tl.store(out, along_columns, mask=on)
    tl.store(out + height * width, along_rows, mask=on)


@triton.jit
def _end(at, size):
    """Which entry of `taps` holds at a row or column: 0 inside, 1 at the first one, 2 at the last one."""
    return tl.where(at == 0, 1, tl.where(at == size - 1, 2, 0))


@_kernel
def transposed_derivatives(maps, taps, height, width, images, count: tl.constexpr, block: tl.constexpr):
    """Adjoint of `derivatives`: what `maps` (B, 2, H, W) send back to images."""
    place, row, column, on = _lanes(height, width, block)
    source = maps + tl.program_id(1).to(tl.int64) * 2 * height * width
    of_row = taps + _end(row, height) * count
    of_column = taps + _end(column, width) * count
    total = tl.zeros([block], tl.float32)
    for i in range(count):
        y = row + i - count // 2
        averaged = tl.zeros([block], tl.float32)
        sloped = tl.zeros([block], tl.float32)
        for j in range(count):
            x = column + j - count // 2
            seen = on & (y >= 0) & (y < height) & (x >= 0) & (x < width)
            at = source + y * width + x
            sloped += tl.load(of_column + 4 * count - 1 - j) * tl.load(at, mask=seen, other=0.0)
            averaged += tl.load(of_column + count - 1 - j) * tl.load(at + height * width, mask=seen, other=0.0)
        total += tl.load(of_row + count - 1 - i) * sloped + tl.load(of_row + 4 * count - 1 - i) * averaged
    tl.store(images + tl.program_id(1).to(tl.int64) * height * width + place, total, mask=on)


@_kernel
def correlate(
    maps,
    fixed,
    mean,
    scale,
    weights,
    height,
    width,
    radius,
    floor,
    parts,
    factors,
    keep: tl.constexpr,
    block: tl.constexpr,
):
    """Each program's part of Σ weight · NCC over the patches of one derivative: `parts` (B, 2, programs) float64.

    With `keep` also `factors` (B, 2, 3, H − 2r, W − 2r) float64, which `spread_back` needs, see `cpu._correlate`.
    """
    rows, columns, side = height - 2 * radius, width - 2 * radius, 2 * radius + 1
    place, top, left, on = _lanes(rows, columns, block)
    derivative = tl.program_id(1) % 2
    moving = maps + tl.program_id(1).to(tl.int64) * height * width + top * width + left
    target = fixed + derivative * height * width + top * width + left
    total = tl.zeros([block], tl.float64)
    squares, products = total, total
    for i in range(side):
        for j in range(side):
            m = tl.load(moving + i * width + j, mask=on, other=0.0).to(tl.float64)
            f = tl.load(target + i * width + j, mask=on, other=0.0).to(tl.float64)
            total += m
            squares += m * m
            products += m * f
    size = (side * side).to(tl.float64)
    spread = squares - total * total / size
    at = derivative * rows * columns + place
    flat = spread <= floor  # nan is not flat, and stays nan
    sound = tl.where(flat, 1.0, spread)
    mean_there = tl.load(mean + at, mask=on, other=0.0)
    a = tl.where(flat, 0.0, tl.load(scale + at, mask=on, other=0.0) / tl.sqrt(sound))
    product = (products - total * mean_there) * a
    weight = tl.load(weights + place, mask=on, other=0.0)
    tl.store(
        parts + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), tl.sum(tl.where(on, weight * product, 0.0))
    )
    if keep:
        b = product / sound
        out = factors + tl.program_id(1).to(tl.int64) * 3 * rows * columns + place
        tl.store(out, weight * a, mask=on)
        tl.store(out + rows * columns, weight * b, mask=on)
        tl.store(out + 2 * rows * columns, weight * (a * mean_there - b * total / size), mask=on)


@_kernel
def spread_back(maps, fixed, factors, height, width, radius, out, block: tl.constexpr):
    """Half the gradient (B, 2, H, W) of Σ weight · NCC by the derivative maps: the mean of both derivatives counts."""
    rows, columns, side = height - 2 * radius, width - 2 * radius, 2 * radius + 1
    place, row, column, on = _lanes(height, width, block)
    source = factors + tl.program_id(1).to(tl.int64) * 3 * rows * columns
    a = tl.zeros([block], tl.float64)
    b, c = a, a
    for i in range(side):
        for j in range(side):
            top, left = row - i, column - j
            seen = on & (top >= 0) & (top < rows) & (left >= 0) & (left < columns)
            at = source + top * columns + left
            a += tl.load(at, mask=seen, other=0.0)
            b += tl.load(at + rows * columns, mask=seen, other=0.0)
            c += tl.load(at + 2 * rows * columns, mask=seen, other=0.0)
    here = tl.program_id(1).to(tl.int64) * height * width + place
    m = tl.load(maps + here, mask=on, other=0.0)
    f = tl.load(fixed + tl.program_id(1) % 2 * height * width + place, mask=on, other=0.0)
    tl.store(out + here, (0.5 * (f * a - m * b - c)).to(tl.float32), mask=on)


# Curvature ------------------------------------------------------------------------------------------------------------
@_kernel
def shares(
    maps, fixed, scale, weights, height, width, radius, stride, floor, mean, of_mean, of_along, block: tl.constexpr
):
    """Of every stride-th patch of one image, (2, patches) float32: its mean, and roots of what it weighs.

    See `curvature.patch_curvature`; the weights are not divided by their sum.
    """
    side = 2 * radius + 1
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    place, row, column, on = _lanes(rows, columns, block)
    derivative = tl.program_id(1)
    top, left = row * stride, column * stride
    corner = derivative * height * width + top * width + left
    total = tl.zeros([block], tl.float64)
    squares, of_fixed, products = total, total, total
    for i in range(side):
        for j in range(side):
            m = tl.load(maps + corner + i * width + j, mask=on, other=0.0).to(tl.float64)
            f = tl.load(fixed + corner + i * width + j, mask=on, other=0.0).to(tl.float64)
            total += m
            squares += m * m
            of_fixed += f
            products += m * f
    size = (side * side).to(tl.float64)
    spread = tl.maximum(squares - total * total / size, floor)
    patch = top * (width - 2 * radius) + left
    every = (height - 2 * radius) * (width - 2 * radius)
    scaled = tl.load(scale + derivative * every + patch, mask=on, other=0.0) / tl.sqrt(spread)
    ncc = tl.maximum((products - total * of_fixed / size) * scaled, 0.0)
    share = tl.load(weights + patch, mask=on, other=0.0) * ncc / spread
    at = derivative * rows * columns + place
    tl.store(mean + at, (total / size).to(tl.float32), mask=on)
    tl.store(of_mean + at, tl.sqrt(share / size).to(tl.float32), mask=on)
    tl.store(of_along + at, tl.sqrt(share / spread).to(tl.float32), mask=on)


@_kernel
def cover(of_mean, height, width, radius, stride, root, block: tl.constexpr):
    """The root (2, H, W) of what all of these patches that hold a pixel weigh."""
    side = 2 * radius + 1
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    place, row, column, on = _lanes(height, width, block)
    total = tl.zeros([block], tl.float32)
    for i in range(side // stride + 1):
        for j in range(side // stride + 1):
            down, right = row // stride - i, column // stride - j
            holds = (row - down * stride < side) & (column - right * stride < side)
            seen = on & holds & (down >= 0) & (down < rows) & (right >= 0) & (right < columns)
            at = (tl.program_id(1) * rows + down) * columns + right
            share = tl.load(of_mean + at, mask=seen, other=0.0)
            total += share * share
    size = (side * side).to(tl.float32)
    tl.store(root + tl.program_id(1) * height * width + place, tl.sqrt(total * size), mask=on)


@_kernel
def patch_factors(
    changes,
    maps,
    mean,
    of_mean,
    of_along,
    height,
    width,
    radius,
    stride,
    totals,
    along,
    block: tl.constexpr,
):
    """Sums over patches of changes' derivatives (n, 2, H, W), and their parts along the patches, weighted.

    `totals` and `along` are (n, 2, patches).
    """
    side = 2 * radius + 1
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    place, row, column, on = _lanes(rows, columns, block)
    derivative = tl.program_id(1) % 2
    corner = row * stride * width + column * stride
    change = changes + tl.program_id(1).to(tl.int64) * height * width + corner
    moving = maps + derivative * height * width + corner
    total = tl.zeros([block], tl.float32)
    products = total
    for i in range(side):
        for j in range(side):
            d = tl.load(change + i * width + j, mask=on, other=0.0)
            total += d
            products += d * tl.load(moving + i * width + j, mask=on, other=0.0)
    at = derivative * rows * columns + place
    out = tl.program_id(1).to(tl.int64) * rows * columns + place
    left_over = products - total * tl.load(mean + at, mask=on, other=0.0)
    tl.store(totals + out, total * tl.load(of_mean + at, mask=on, other=0.0), mask=on)
    tl.store(along + out, left_over * tl.load(of_along + at, mask=on, other=0.0), mask=on)


@_kernel
def tile_sums(changes, slope, height, width, tile, across, out, block: tl.constexpr):
    """Sums (n, T) float64 of changes (n, H, W) times slope (H, W) over square tiles; `block` is at least `tile`."""
    top, left = tl.program_id(0) // across * tile, tl.program_id(0) % across * tile
    lane = tl.arange(0, block)
    seen = (lane < tile) & (left + lane < width)
    change = changes + tl.program_id(1).to(tl.int64) * height * width
    total = tl.zeros([block], tl.float64)
    for row in range(top, tl.minimum(top + tile, height)):
        at = row * width + left + lane
        product = tl.load(change + at, mask=seen, other=0.0) * tl.load(slope + at, mask=seen, other=0.0)
        total += product.to(tl.float64)
    tl.store(out + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), tl.sum(total))
