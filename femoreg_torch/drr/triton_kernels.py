# mypy: disable-error-code="no-untyped-def"
"""The projector's kernels in Triton. Importing this module imports Triton; only `cuda.py` does, and only when needed.

One program renders a square tile of rays of one pose. As on the CPU, a ray is `source + t · direction` in padded index
space, and its samples lie whole steps beyond the offset of the pose. What decides where a sample lies is computed in
float64, once per ray; from there on the ray counts in float32 voxels from the voxel it enters by, so that indices of a
thousand cost no accuracy. All rays of a tile are at the same sample number, and leap together, as far as the one that
may leap least.

Tensors, all contiguous: `affines` (B, 3, 4) float64, padded index from camera mm; `geometry` (6,) float64, see
`_unit_rays`; `offsets` (B,) float64, mm; `volume` (depth, height, width) in any float type; `leap` uint8, one per
brick, see `bricks.py`.
"""

import triton
import triton.language as tl

from femoreg_torch.drr import bricks

BRICK = tl.constexpr(bricks.BRICK)
SHIFT = tl.constexpr(bricks.BRICK.bit_length() - 1)
# A brick that is not filled sees zeros up to SPREAD voxels beyond; one is kept back, for the rounding of float32.
BEYOND = tl.constexpr(bricks.SPREAD - 1)
MARGIN = tl.constexpr(bricks.RIM - 2)  # of the rim, left out: values fade to zero one voxel beyond the border
CHUNK = tl.constexpr(bricks.BRICK)  # samples between two looks at the map, about one brick
FAR = tl.constexpr(2**30)  # a sample number that no ray reaches
SANE = tl.constexpr(1e9)  # voxels; float64 knows a place to 1e-7 voxels up to here


# Geometry of a tile --------------------------------------------------------------------------------------------------
@triton.jit
def _affine_row(affines, pose, row):
    entry = affines + pose * 12 + row * 4
    return tl.load(entry), tl.load(entry + 1), tl.load(entry + 2), tl.load(entry + 3)


@triton.jit
def _pixels(rows, columns, tile: tl.constexpr):
    """Row and column of this program's rays, whether these lie on the detector, and their places in an image."""
    across = tl.cdiv(columns, tile)
    ray = tl.arange(0, tile * tile)
    row = tl.program_id(0) // across * tile + ray // tile
    column = tl.program_id(0) % across * tile + ray % tile
    place = (tl.program_id(1).to(tl.int64) * rows + row) * columns + column
    return row, column, (row < rows) & (column < columns), place


@triton.jit
def _unit_rays(geometry, row, column):
    """Unit rays in the camera frame. `geometry`: source to detector, row and column spacing, principal point, step."""
    z = tl.load(geometry)
    y = (row - tl.load(geometry + 4)) * tl.load(geometry + 1)
    x = (column - tl.load(geometry + 3)) * tl.load(geometry + 2)
    scale = 1.0 / tl.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@triton.jit
def _clip(enter, leave, source, direction, size):
    """Narrow [enter, leave] to where one coordinate is at least MARGIN within the padded volume."""
    divisor = tl.where(tl.abs(direction) < 1e-12, 1e-12, direction)  # a ray along the slab stays in it or out of it
    a = (MARGIN - source) / divisor
    b = (size - 1 - MARGIN - source) / divisor
    return tl.maximum(enter, tl.minimum(a, b)), tl.minimum(leave, tl.maximum(a, b))


@triton.jit
def _axis(source, direction, nearest, step):
    """Where a ray's first sample, `nearest` mm from the source, lies along one axis.

    Voxel and float32 rest; then float32 voxels per sample.
    """
    start = source + nearest * direction
    voxel = tl.floor(start)
    return voxel.to(tl.int32), (start - voxel).to(tl.float32), (step * direction).to(tl.float32)


@triton.jit
def _rays(affines, pose, offset, step, x, y, z, on, depth, height, width):
    """First sample and number of samples of each ray, three axes as in `_axis`, and 0, or nan if the pose is not sane.

    A pose cannot be looked at from the host without waiting for the device. One with nan, inf or absurd numbers renders
    as nan, and its rays take no samples, so that none reads outside the volume.
    """
    ax, bx, cx, source_x = _affine_row(affines, pose, 0)
    ay, by, cy, source_y = _affine_row(affines, pose, 1)
    az, bz, cz, source_z = _affine_row(affines, pose, 2)
    dx = ax * x + bx * y + cx * z
    dy = ay * x + by * y + cy * z
    dz = az * x + bz * y + cz * z
    size = tl.abs(source_x) + tl.abs(source_y) + tl.abs(source_z) + tl.abs(dx) + tl.abs(dy) + tl.abs(dz)
    sane = size < SANE

    enter, leave = _clip(tl.zeros_like(dx), tl.full(dx.shape, 1e9, tl.float64), source_x, dx, width)
    enter, leave = _clip(enter, leave, source_y, dy, height)
    enter, leave = _clip(enter, leave, source_z, dz, depth)
    hit = on & sane & (enter <= leave)
    first = tl.where(hit, tl.ceil(tl.minimum((enter - offset) / step + 1e-9, FAR)), 0).to(tl.int32)
    last = tl.where(hit, tl.floor(tl.minimum((leave - offset) / step - 1e-9, FAR)), -1).to(tl.int32)
    count = tl.maximum(last - first + 1, 0)

    nearest = offset + first * step
    along_x = _axis(source_x, dx, nearest, step)
    along_y = _axis(source_y, dy, nearest, step)
    along_z = _axis(source_z, dz, nearest, step)
    return first, count, along_x, along_y, along_z, tl.where(sane, 0.0, float("nan"))


# Leaping -------------------------------------------------------------------------------------------------------------
@triton.jit
def _exit(axis, voxel, reach):
    """Samples from a ray's first to where it leaves, along one axis, the brick of `voxel` grown by `reach` voxels."""
    entry, rest, per_sample = axis
    brick = voxel >> SHIFT << SHIFT
    face = tl.where(per_sample > 0, brick + BRICK + reach, brick - reach) - entry
    return (face.to(tl.float32) - rest) / tl.where(tl.abs(per_sample) < 1e-12, 1e-12, per_sample)


@triton.jit
def _voxel(axis, n):
    """Voxel below the n-th sample along one axis, and the sample's place in it, 0 … 1."""
    entry, rest, per_sample = axis
    offset = rest + n * per_sample
    below = tl.floor(offset)
    return entry + below.to(tl.int32), offset - below


@triton.jit
def _next(leap, k, first, count, along_x, along_y, along_z, height, width):
    """Each ray's next sample, from the k-th on, that may see something; FAR if there is none."""
    n = k - first
    inside = (n >= 0) & (n < count)
    x, _ = _voxel(along_x, n)
    y, _ = _voxel(along_y, n)
    z, _ = _voxel(along_z, n)
    brick = ((z >> SHIFT) * (height >> SHIFT) + (y >> SHIFT)) * (width >> SHIFT) + (x >> SHIFT)
    distance = tl.load(leap + brick, mask=inside, other=0).to(tl.int32)
    reach = (distance - 1) * BRICK + BEYOND
    out = tl.minimum(_exit(along_x, x, reach), tl.minimum(_exit(along_y, y, reach), _exit(along_z, z, reach)))
    beyond = first + tl.minimum(out, count.to(tl.float32)).to(tl.int32) + 1
    found = tl.where(distance == 0, k, tl.maximum(beyond, k + 1))
    return tl.where(count == 0, FAR, tl.where(n < 0, first, tl.where(inside, found, FAR)))


# Sums along rays -----------------------------------------------------------------------------------------------------
@triton.jit
def _value(voxel, seen):
    return tl.load(voxel, mask=seen, other=0.0).to(tl.float32)


@triton.jit
def _sample(volume, n, seen, along_x, along_y, along_z, height, width):
    """Trilinear value of each ray's n-th sample, and its slope along x, y and z; zeros where not `seen`."""
    x, u = _voxel(along_x, n)
    y, v = _voxel(along_y, n)
    z, w = _voxel(along_z, n)
    p = volume + ((z * height + y) * width + x)
    q = p + height * width
    c000, c001, c010, c011 = _value(p, seen), _value(p + 1, seen), _value(p + width, seen), _value(p + width + 1, seen)
    c100, c101, c110, c111 = _value(q, seen), _value(q + 1, seen), _value(q + width, seen), _value(q + width + 1, seen)
    d00, d01, d10, d11 = c001 - c000, c011 - c010, c101 - c100, c111 - c110
    a, b, c, d = c000 + u * d00, c010 + u * d01, c100 + u * d10, c110 + u * d11
    low, high = a + v * (b - a), c + v * (d - c)
    e0, e1 = d00 + v * (d01 - d00), d10 + v * (d11 - d10)
    return low + w * (high - low), e0 + w * (e1 - e0), (b - a) + w * ((d - c) - (b - a)), high - low


@triton.jit
def _march(volume, leap, first, count, along_x, along_y, along_z, height, width):
    """Per ray: Σ value, Σ slope (3), Σ n · slope (3), n counted from the ray's first sample.

    Sums that a kernel does not use cost nothing: the compiler drops them.
    """
    total = tl.zeros(first.shape, tl.float32)
    sx, sy, sz, nx, ny, nz = total, total, total, total, total, total
    k = tl.min(tl.where(count > 0, first, FAR))
    end = tl.max(tl.where(count > 0, first + count, 0))
    while k < end:
        following = _next(leap, k, first, count, along_x, along_y, along_z, height, width)
        nearest = tl.min(following)
        if nearest > k:
            k = nearest
        else:
            for _ in tl.static_range(CHUNK):
                n = k - first
                # A ray that may leap over what is left of the chunk has nothing to read there.
                seen = (n >= 0) & (n < count) & (following <= k)
                value, gx, gy, gz = _sample(volume, n, seen, along_x, along_y, along_z, height, width)
                total += value
                sx += gx
                sy += gy
                sz += gz
                nx += n * gx
                ny += n * gy
                nz += n * gz
                k += 1
    return total, sx, sy, sz, nx, ny, nz


@triton.jit
def _moments(volume, leap, affines, geometry, offsets, x, y, z, on, depth, height, width):
    """Per ray, times the step: Σ value, then in float64 Σ slope (3) and Σ t · slope (3), t mm from the source."""
    step, offset = tl.load(geometry + 5), tl.load(offsets + tl.program_id(1))
    first, count, along_x, along_y, along_z, fault = _rays(
        affines, tl.program_id(1), offset, step, x, y, z, on, depth, height, width
    )
    total, sx, sy, sz, nx, ny, nz = _march(volume, leap, first, count, along_x, along_y, along_z, height, width)
    image = step * total + fault
    t = offset + first * step
    sx, sy, sz = step * sx + fault, step * sy + fault, step * sz + fault
    return image, sx, sy, sz, t * sx + step * step * nx, t * sy + step * step * ny, t * sz + step * step * nz


# Kernels: tiles × poses ----------------------------------------------------------------------------------------------
# Compiled once for all sizes: that a size is 1 or a multiple of 16, or numbers begin at such a place, for which Triton
# would compile anew, helps nothing.
_SIZES = ["depth", "height", "width", "rows", "columns", "dofs"]
_kernel = triton.jit(do_not_specialize=[*_SIZES, "affines", "geometry", "offsets", "changes", "rates"])


@_kernel
def forward(volume, leap, affines, geometry, offsets, depth, height, width, rows, columns, image, tile: tl.constexpr):
    """Line integrals `image` (B, H, W) float32."""
    row, column, on, place = _pixels(rows, columns, tile)
    x, y, z = _unit_rays(geometry, row, column)
    value, _, _, _, _, _, _ = _moments(volume, leap, affines, geometry, offsets, x, y, z, on, depth, height, width)
    tl.store(image + place, value.to(tl.float32), mask=on)


@_kernel
def pose_gradient(
    volume, leap, affines, geometry, offsets, depth, height, width, rows, columns, upstream, parts, tile: tl.constexpr
):
    """Each tile's part of the gradient by `affines` and `offsets`: `parts` (B, tiles, 13) float64.

    The caller sums them.
    No atomics, so that two runs agree bit for bit.
    """
    row, column, on, place = _pixels(rows, columns, tile)
    x, y, z = _unit_rays(geometry, row, column)
    _, sx, sy, sz, tx, ty, tz = _moments(volume, leap, affines, geometry, offsets, x, y, z, on, depth, height, width)
    weight = tl.load(upstream + place, mask=on, other=0.0)
    part = parts + (tl.program_id(1).to(tl.int64) * tl.num_programs(0) + tl.program_id(0)) * 13
    _store_row(part, weight, sx, tx, x, y, z)
    _store_row(part + 4, weight, sy, ty, x, y, z)
    _store_row(part + 8, weight, sz, tz, x, y, z)
    pose = tl.program_id(1)
    along = _along(affines, pose, 0, sx, x, y, z) + _along(affines, pose, 1, sy, x, y, z)
    along += _along(affines, pose, 2, sz, x, y, z)
    tl.store(part + 12, tl.sum(weight * along))


@triton.jit
def _store_row(part, weight, s, t, x, y, z):
    """One row of the gradient: a sample at t · ray moves by t · ray times the linear part, and by the shift."""
    tl.store(part, tl.sum(weight * t * x))
    tl.store(part + 1, tl.sum(weight * t * y))
    tl.store(part + 2, tl.sum(weight * t * z))
    tl.store(part + 3, tl.sum(weight * s))


@triton.jit
def _along(affines, pose, row, s, x, y, z):
    """What one row of the affine has in the derivative along the ray."""
    a, b, c, _ = _affine_row(affines, pose, row)
    return s * (a * x + b * y + c * z)


@triton.jit
def _change(changes, row, s, t, x, y, z):
    a, b, c, shift = _affine_row(changes, 0, row)
    return t * (a * x + b * y + c * z) + s * shift


@_kernel
def jacobian(
    volume,
    leap,
    affines,
    geometry,
    offsets,
    depth,
    height,
    width,
    rows,
    columns,
    changes,
    rates,
    dofs,
    image,
    out,
    tile: tl.constexpr,
):
    """Line integrals `image` (B, H, W), and their derivatives `out` (B, dofs, H, W) along `changes` (B, dofs, 3, 4).

    The offsets change by `rates` (B, dofs).
    """
    row, column, on, place = _pixels(rows, columns, tile)
    x, y, z = _unit_rays(geometry, row, column)
    value, sx, sy, sz, tx, ty, tz = _moments(
        volume, leap, affines, geometry, offsets, x, y, z, on, depth, height, width
    )
    tl.store(image + place, value.to(tl.float32), mask=on)
    pose = tl.program_id(1)
    along = _along(affines, pose, 0, sx, x, y, z) + _along(affines, pose, 1, sy, x, y, z)
    along += _along(affines, pose, 2, sz, x, y, z)
    for dof in range(dofs):
        plane = pose.to(tl.int64) * dofs + dof
        change = changes + plane * 12
        slope = _change(change, 0, sx, tx, x, y, z) + _change(change, 1, sy, ty, x, y, z)
        slope += _change(change, 2, sz, tz, x, y, z) + tl.load(rates + plane) * along
        tl.store(out + plane * rows * columns + row * columns + column, slope.to(tl.float32), mask=on)


@_kernel
def volume_gradient(
    affines, geometry, offsets, depth, height, width, rows, columns, upstream, gradient, tile: tl.constexpr
):
    """Add to `gradient` (depth, height, width) float32. Nothing is skipped: what is empty may well have a gradient.

    By atomics, in no set order: two runs agree to rounding only.
    """
    row, column, on, place = _pixels(rows, columns, tile)
    x, y, z = _unit_rays(geometry, row, column)
    step, offset = tl.load(geometry + 5), tl.load(offsets + tl.program_id(1))
    _, count, along_x, along_y, along_z, fault = _rays(
        affines, tl.program_id(1), offset, step, x, y, z, on, depth, height, width
    )
    share = (step * tl.load(upstream + place, mask=on, other=0.0) + fault).to(tl.float32)
    for n in range(tl.max(count)):
        seen = n < count
        i, u = _voxel(along_x, n)
        j, v = _voxel(along_y, n)
        k, w = _voxel(along_z, n)
        p = gradient + ((k * height + j) * width + i)
        _add_row(p, share * (1 - v) * (1 - w), u, seen)
        _add_row(p + width, share * v * (1 - w), u, seen)
        _add_row(p + height * width, share * (1 - v) * w, u, seen)
        _add_row(p + height * width + width, share * v * w, u, seen)


@triton.jit
def _add_row(voxel, share, u, seen):
    tl.atomic_add(voxel, share * (1 - u), mask=seen, sem="relaxed")
    tl.atomic_add(voxel + 1, share * u, mask=seen, sem="relaxed")
