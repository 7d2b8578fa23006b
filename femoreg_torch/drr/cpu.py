"""The projector on the CPU: compiled by numba, on all cores, with empty-space skipping for packets of rays.

All kernels walk the rays of one volume in the same way. A ray is `source + t · direction` in padded index space, t mm
from the X-ray source; samples lie whole steps beyond the offset of the pose (`drr.sampling`), whatever else is in the
batch. The detector is cut into square packets, small enough that all rays of one stay within SPREAD voxels of its
middle. The middle ray alone finds the runs of samples that may see something; every ray of the packet then takes them.
"""

import math

import numba as nb
import numpy as np
from numba.extending import intrinsic
from numpy.typing import NDArray

from femoreg_torch.drr.bricks import BRICK, RIM, SPREAD, BrickedVolume
from femoreg_torch.geometry.camera import Camera

_flags = {"contract", "reassoc", "nsz", "arcp"}  # nan and inf keep their meaning
_jit = nb.njit(cache=True, fastmath=_flags, error_model="numpy")
_parallel = nb.njit(cache=True, fastmath=_flags, error_model="numpy", parallel=True, nogil=True)

_SHIFT = BRICK.bit_length() - 1
_MOST_RUNS = 256  # per ray; a ray through 1,024 bricks that are filled and empty by turns has fewer
_MOST_RAYS = 8  # along the edge of a packet

Array = NDArray[np.float64]


# Geometry of one ray -------------------------------------------------------------------------------------------------
@_jit
def _ray(affine, detector, row, column):  # type: ignore[no-untyped-def]
    """Unit ray of a pixel in the camera frame, and its direction in index space per mm."""
    x = (column - detector[3]) * detector[2]
    y = (row - detector[4]) * detector[1]
    z = detector[0]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    dx = affine[0, 0] * x + affine[0, 1] * y + affine[0, 2] * z
    dy = affine[1, 0] * x + affine[1, 1] * y + affine[1, 2] * z
    dz = affine[2, 0] * x + affine[2, 1] * y + affine[2, 2] * z
    return x, y, z, dx, dy, dz


@_jit
def _clip(source, direction, size, margin, enter, leave):  # type: ignore[no-untyped-def]
    """Narrow [enter, leave] to where margin ≤ source + t · direction ≤ size − 1 − margin."""
    low, high = margin, size - 1.0 - margin
    if direction != 0.0:
        a = (low - source) / direction
        b = (high - source) / direction
        return max(enter, min(a, b)), min(leave, max(a, b))
    if source < low or source > high:
        return 1.0, 0.0
    return enter, leave


@_jit
def _bounds(shape, margin, offset, step, source, dx, dy, dz):  # type: ignore[no-untyped-def]
    """First and last sample of a ray at least `margin` voxels inside the padded volume; last < first if none."""
    enter, leave = _clip(source[0], dx, shape[2], margin, 0.0, 1e9)
    enter, leave = _clip(source[1], dy, shape[1], margin, enter, leave)
    enter, leave = _clip(source[2], dz, shape[0], margin, enter, leave)
    if leave < enter:
        return 0, -1
    return math.ceil((enter - offset) / step + 1e-9), math.floor((leave - offset) / step - 1e-9)


@_jit
def _exit(source, inverse, low, high):  # type: ignore[no-untyped-def]
    """Distance along the ray at which it leaves the slab [low, high]; `inverse` is 1 / direction."""
    return ((high if inverse > 0.0 else low) - source) * inverse


@_jit
def _inverse(direction):  # type: ignore[no-untyped-def]
    return 1.0 / direction if abs(direction) > 1e-12 else 1e12


@_jit
def _runs(leap, shape, offset, step, source, dx, dy, dz, starts, ends):  # type: ignore[no-untyped-def]
    """Runs of samples [start, end) of a packet's middle ray that may see something; returns how many."""
    k, last = _bounds(shape, float(SPREAD), offset, step, source, dx, dy, dz)
    x, y, z, size, per_step = source[0], source[1], source[2], float(BRICK), 1.0 / step
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    n = 0
    while k <= last:
        t = offset + k * step
        bx, by, bz = int(x + t * dx) >> _SHIFT, int(y + t * dy) >> _SHIFT, int(z + t * dz) >> _SHIFT
        distance = leap[bz, by, bx]
        reach = distance - 1 if distance > 0 else 0
        out = min(
            _exit(x, ix, (bx - reach) * size, (bx + 1 + reach) * size),
            _exit(y, iy, (by - reach) * size, (by + 1 + reach) * size),
            _exit(z, iz, (bz - reach) * size, (bz + 1 + reach) * size),
        )
        beyond = min(max(k + 1, int((out - offset) * per_step) + 1), last + 1)
        if distance == 0:
            if n > 0 and (ends[n - 1] == k or n == _MOST_RUNS):
                ends[n - 1] = beyond
            else:
                starts[n], ends[n] = k, beyond
                n += 1
        k = beyond
    return n


@_jit
def _edges(affines, shape, slope, edges):  # type: ignore[no-untyped-def]
    """See `_packet_edges`; neighbouring rays part by `slope` mm per mm. Compiled, for small images take no longer."""
    inverse = np.empty((3, 3))
    for pose in range(len(affines)):
        linear, source = affines[pose, :, :3], affines[pose, :, 3]
        for i in range(3):
            for j in range(3):
                a, b, c, d = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
                inverse[i, j] = linear[a, c] * linear[b, d] - linear[a, d] * linear[b, c]
        determinant = linear[0, 0] * inverse[0, 0] + linear[0, 1] * inverse[1, 0] + linear[0, 2] * inverse[2, 0]

        farthest = 0.0  # corner of the volume, mm² from the source
        for corner in range(8):
            x = (shape[2] if corner & 1 else -1.0) - source[0]
            y = (shape[1] if corner & 2 else -1.0) - source[1]
            z = (shape[0] if corner & 4 else -1.0) - source[2]
            squared = 0.0
            for i in range(3):
                squared += ((inverse[i, 0] * x + inverse[i, 1] * y + inverse[i, 2] * z) / determinant) ** 2
            farthest = max(farthest, squared)

        # Gershgorin's bound of the largest singular value, which is that value on a grid with right angles.
        most = 0.0  # (voxels per mm)²
        for i in range(3):
            bound = 0.0
            for j in range(3):
                bound += abs(linear[i, 0] * linear[j, 0] + linear[i, 1] * linear[j, 1] + linear[i, 2] * linear[j, 2])
            most = max(most, bound)
        per_ray = slope * math.sqrt(farthest * most)
        edges[pose] = min(max(1 + int(SPREAD * math.sqrt(2.0) / per_ray), 1), _MOST_RAYS)


# Sums along one run of one ray ---------------------------------------------------------------------------------------
@intrinsic
def _pair(typing, flat, place):  # type: ignore[no-untyped-def]
    """`flat[place]` and `flat[place + 1]`, both float32, by one load of 64 bits, little-endian as numba's machines are.

    LLVM gathers for eight samples at a time, and gathers take their time by how many numbers they fetch, not by how
    wide these are. To be called from the loop itself: LLVM takes the load apart again in a function of its own.
    """

    def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        single, half, whole = (context.get_value_type(t) for t in (nb.float32, nb.uint32, nb.uint64))
        first = builder.gep(context.make_array(flat)(context, builder, arguments[0]).data, [arguments[1]])
        both = builder.load(builder.bitcast(first, whole.as_pointer()), align=4)
        above = builder.lshr(both, context.get_constant(nb.uint64, 32))
        values = [builder.bitcast(builder.trunc(one, half), single) for one in (both, above)]
        return context.make_tuple(builder, signature.return_type, values)

    return nb.types.UniTuple(nb.float32, 2)(flat, nb.uintp), emit


@_jit
def _lowest(source, direction, t0, t1):  # type: ignore[no-untyped-def]
    """Lowest voxel that a run touches along one axis, and the float32 offset of its first sample from it."""
    first = source + t0 * direction
    low = int(min(first, source + t1 * direction))
    return low, np.float32(first - low)


@_jit
def _start(source, first, end, offset, step, dx, dy, dz, height, width):  # type: ignore[no-untyped-def]
    """A run's lowest corner (as a flat index), the offset of its first sample from it, and the offset per sample."""
    i, x = _lowest(source[0], dx, offset + first * step, offset + (end - 1) * step)
    j, y = _lowest(source[1], dy, offset + first * step, offset + (end - 1) * step)
    k, z = _lowest(source[2], dz, offset + first * step, offset + (end - 1) * step)
    base = (k * height + j) * width + i
    return base, x, y, z, np.float32(dx * step), np.float32(dy * step), np.float32(dz * step)


@_jit
def _integral(flat, height, width, first, end, offset, step, source, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Sum of the trilinear values of samples first … end − 1. Offsets are float32, from the run's lowest voxel."""
    base, x0, y0, z0, ax, ay, az = _start(source, first, end, offset, step, dx, dy, dz, height, width)
    row, slab = np.int32(width), np.int32(height * width)
    total = np.float32(0.0)
    for n in range(end - first):
        s = np.float32(n)
        x, y, z = x0 + s * ax, y0 + s * ay, z0 + s * az
        i, j, k = np.int32(x), np.int32(y), np.int32(z)
        u, v, w = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        place = np.uintp(base + np.int64(k * slab + j * row + i))
        across, behind = place + np.uintp(width), place + np.uintp(height * width)
        c000, c001 = _pair(flat, place)
        c010, c011 = _pair(flat, across)
        c100, c101 = _pair(flat, behind)
        c110, c111 = _pair(flat, behind + np.uintp(width))
        a0, a1 = c000 + v * (c010 - c000), c001 + v * (c011 - c001)
        b0, b1 = c100 + v * (c110 - c100), c101 + v * (c111 - c101)
        a0 += w * (b0 - a0)
        a1 += w * (b1 - a1)
        total += a0 + u * (a1 - a0)
    return total


@_jit
def _moments(flat, height, width, first, end, offset, step, source, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Σ slope (3) and Σ t · slope (3) over a run: all that a derivative by the affine needs; then Σ value."""
    base, x0, y0, z0, ax, ay, az = _start(source, first, end, offset, step, dx, dy, dz, height, width)
    row, slab = np.int32(width), np.int32(height * width)
    sx = sy = sz = np.float32(0.0)  # Σ slope
    nx = ny = nz = np.float32(0.0)  # Σ n · slope, n counted from the run's first sample
    total = np.float32(0.0)
    for n in range(end - first):
        s = np.float32(n)
        x, y, z = x0 + s * ax, y0 + s * ay, z0 + s * az
        i, j, k = np.int32(x), np.int32(y), np.int32(z)
        u, v, w = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        place = np.uintp(base + np.int64(k * slab + j * row + i))
        across, behind = place + np.uintp(width), place + np.uintp(height * width)
        c000, c001 = _pair(flat, place)
        c010, c011 = _pair(flat, across)
        c100, c101 = _pair(flat, behind)
        c110, c111 = _pair(flat, behind + np.uintp(width))
        d00, d01, d10, d11 = c001 - c000, c011 - c010, c101 - c100, c111 - c110
        e0, e1 = d00 + v * (d01 - d00), d10 + v * (d11 - d10)
        a, b = c000 + u * d00, c010 + u * d01
        c, d = c100 + u * d10, c110 + u * d11
        low, high = a + v * (b - a), c + v * (d - c)
        gx, gy, gz = e0 + w * (e1 - e0), (b - a) + w * ((d - c) - (b - a)), high - low
        sx += gx
        sy += gy
        sz += gz
        nx += s * gx
        ny += s * gy
        nz += s * gz
        total += low + w * (high - low)
    t = offset + first * step
    return sx, sy, sz, t * sx + step * nx, t * sy + step * ny, t * sz + step * nz, total


@_jit
def _first_packet(principal, edge):  # type: ignore[no-untyped-def]
    """Row or column, at most 0, where the first packet begins: packets are counted from the principal point.

    A window of the detector is thus cut into the same packets, and renders the same, as the whole.
    """
    return -(-math.floor(principal) % edge)


# Kernels: poses × packets, shared out among the cores ----------------------------------------------------------------
@_parallel
def _forward(padded, leap, affines, detector, offsets, step, edges, workers, out):  # type: ignore[no-untyped-def]
    poses, rows, columns = out.shape
    flat = padded.reshape(-1)
    height, width = padded.shape[1], padded.shape[2]
    for worker in nb.prange(workers):
        starts, ends = np.empty(_MOST_RUNS, np.int64), np.empty(_MOST_RUNS, np.int64)
        for pose in range(poses):
            affine, offset, edge = affines[pose], offsets[pose], edges[pose]
            source = affine[:, 3]
            first_top, first_left = _first_packet(detector[4], edge), _first_packet(detector[3], edge)
            bands = -(-(rows - first_top) // edge)
            for band in range((worker + pose) % workers, bands, workers):
                top = first_top + band * edge
                for left in range(first_left, columns, edge):
                    middle_row, middle_column = top + (edge - 1) / 2, left + (edge - 1) / 2
                    _, _, _, dx, dy, dz = _ray(affine, detector, middle_row, middle_column)
                    n = _runs(leap, padded.shape, offset, step, source, dx, dy, dz, starts, ends)
                    if n > 0:
                        for row in range(max(top, 0), min(top + edge, rows)):
                            for column in range(max(left, 0), min(left + edge, columns)):
                                _, _, _, dx, dy, dz = _ray(affine, detector, row, column)
                                total = np.float32(0.0)
                                for i in range(n):
                                    total += _integral(
                                        flat, height, width, starts[i], ends[i], offset, step, source, dx, dy, dz
                                    )
                                out[pose, row, column] = np.float32(step) * total


@_parallel
def _with_moments(padded, leap, affines, detector, offsets, step, edges, workers, image, moments):  # type: ignore[no-untyped-def]
    poses, rows, columns = image.shape
    flat = padded.reshape(-1)
    height, width = padded.shape[1], padded.shape[2]
    for worker in nb.prange(workers):
        starts, ends = np.empty(_MOST_RUNS, np.int64), np.empty(_MOST_RUNS, np.int64)
        for pose in range(poses):
            affine, offset, edge = affines[pose], offsets[pose], edges[pose]
            source = affine[:, 3]
            first_top, first_left = _first_packet(detector[4], edge), _first_packet(detector[3], edge)
            bands = -(-(rows - first_top) // edge)
            for band in range((worker + pose) % workers, bands, workers):
                top = first_top + band * edge
                for left in range(first_left, columns, edge):
                    middle_row, middle_column = top + (edge - 1) / 2, left + (edge - 1) / 2
                    _, _, _, dx, dy, dz = _ray(affine, detector, middle_row, middle_column)
                    n = _runs(leap, padded.shape, offset, step, source, dx, dy, dz, starts, ends)
                    if n > 0:
                        for row in range(max(top, 0), min(top + edge, rows)):
                            for column in range(max(left, 0), min(left + edge, columns)):
                                _, _, _, dx, dy, dz = _ray(affine, detector, row, column)
                                sx = sy = sz = tx = ty = tz = total = 0.0
                                for i in range(n):
                                    ax, ay, az, bx, by, bz, value = _moments(
                                        flat, height, width, starts[i], ends[i], offset, step, source, dx, dy, dz
                                    )
                                    sx += ax
                                    sy += ay
                                    sz += az
                                    tx += bx
                                    ty += by
                                    tz += bz
                                    total += value
                                image[pose, row, column] = step * total
                                mine = moments[pose, row, column]
                                mine[0], mine[1], mine[2] = step * sx, step * sy, step * sz
                                mine[3], mine[4], mine[5] = step * tx, step * ty, step * tz


@_parallel
def _scatter(affines, detector, offsets, step, workers, upstream, parts):  # type: ignore[no-untyped-def]
    poses, rows, columns = upstream.shape
    shape = parts.shape[1:]
    for worker in nb.prange(workers):
        mine = parts[worker]
        for line in range(worker, poses * rows, workers):
            pose, row = line // rows, line % rows
            affine, offset = affines[pose], offsets[pose]
            source = affine[:, 3]
            for column in range(columns):
                share = step * upstream[pose, row, column]
                if share != 0.0:
                    _, _, _, dx, dy, dz = _ray(affine, detector, row, column)
                    first, last = _bounds(shape, 0.0, offset, step, source, dx, dy, dz)
                    for k in range(first, last + 1):
                        t = offset + k * step
                        x, y, z = source[0] + t * dx, source[1] + t * dy, source[2] + t * dz
                        i, j, n = int(x), int(y), int(z)
                        u, v, w = x - i, y - j, z - n
                        for corner in range(8):
                            p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
                            portion = (u if p else 1 - u) * (v if q else 1 - v) * (w if r else 1 - w)
                            mine[n + r, j + q, i + p] += np.float32(share * portion)


@_parallel
def _by_parameters(moments, detector, changes, slides, out):  # type: ignore[no-untyped-def]
    """Derivatives (B, n, H, W) from moments (B, H, W, 6), see `jacobian`."""
    poses, count, rows, columns = out.shape
    identity = np.eye(3)
    for line in nb.prange(poses * rows):
        pose, row = line // rows, line % rows
        for column in range(columns):
            mine = moments[pose, row, column]
            if mine[0] == 0.0 and mine[1] == 0.0 and mine[2] == 0.0:  # a ray that meets nothing
                continue
            x, y, z, _, _, _ = _ray(identity, detector, row, column)
            for n in range(count):
                change, slide = changes[pose, n], slides[pose, n]
                total = 0.0
                for i in range(3):
                    of_ray = change[i, 0] * x + change[i, 1] * y + change[i, 2] * z
                    along = slide[i, 0] * x + slide[i, 1] * y + slide[i, 2] * z
                    total += mine[3 + i] * of_ray + mine[i] * (change[i, 3] + along)
                out[pose, n, row, column] = total


# What the operator calls ---------------------------------------------------------------------------------------------
def _detector(camera: Camera) -> Array:
    return np.array([camera.sdd_mm, *camera.pixel_mm, *camera.principal_point_px])


def _padded_affines(affines: Array) -> Array:
    shifted = np.ascontiguousarray(affines, np.float64).copy()
    shifted[:, :, 3] += RIM
    return shifted


def _packet_edges(volume: BrickedVolume, affines: Array, camera: Camera) -> NDArray[np.int64]:
    """Rays (B,) along the edge of a packet, such that none strays further than SPREAD voxels from the middle.

    Each pose has its own, so that it renders the same whatever else is in the batch.
    """
    edges = np.empty(len(affines), np.int64)
    _edges(np.ascontiguousarray(affines, np.float64), volume.shape, max(camera.pixel_mm) / camera.sdd_mm, edges)
    return edges


def projection(
    volume: BrickedVolume, affines: Array, camera: Camera, offsets: Array, step_mm: float
) -> NDArray[np.float32]:
    """Line integrals (B, H, W) of one volume for `affines` (B, 3, 4), index from camera mm, and offsets (B,) mm."""
    edges = _packet_edges(volume, affines, camera)
    image = np.zeros((len(affines), *camera.shape), np.float32)
    padded = _padded_affines(affines)
    _forward(
        volume.padded, volume.leap, padded, _detector(camera), offsets, step_mm, edges, nb.get_num_threads(), image
    )
    return image


def projection_with_moments(
    volume: BrickedVolume, affines: Array, camera: Camera, offsets: Array, step_mm: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Line integrals (B, H, W), and the moments (B, H, W, 6) that hold their derivatives (`drr.moments`)."""
    edges = _packet_edges(volume, affines, camera)
    image = np.zeros((len(affines), *camera.shape), np.float32)
    moments = np.zeros((*image.shape, 6), np.float32)
    padded, workers = _padded_affines(affines), nb.get_num_threads()
    _with_moments(
        volume.padded, volume.leap, padded, _detector(camera), offsets, step_mm, edges, workers, image, moments
    )
    return image, moments


def jacobian(moments: NDArray[np.float32], camera: Camera, changes: Array, slides: Array) -> NDArray[np.float32]:
    """Derivatives (B, n, H, W) of images by n parameters, from moments (B, H, W, 6), see `drr.moments`.

    `changes` (B, n, 3, 4) are the derivatives of the affines with respect to the parameters. With `slides` (B, n, 3, 3)
    the samples slide along each unit ray u by that matrix times u, in index space.
    """
    out = np.zeros((*changes.shape[:2], *camera.shape), np.float32)
    numbers = (np.ascontiguousarray(values, np.float64) for values in (changes, slides))
    _by_parameters(moments, _detector(camera), *numbers, out)
    return out


def volume_gradient(
    volume: BrickedVolume, affines: Array, camera: Camera, offsets: Array, step_mm: float, upstream: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Gradient (Z, Y, X) of Σ upstream · image with respect to the volume's data; `upstream` is (B, H, W)."""
    workers = nb.get_num_threads()
    parts = np.zeros((workers, *volume.padded.shape), np.float32)
    _scatter(_padded_affines(affines), _detector(camera), offsets, step_mm, workers, upstream, parts)
    inside = tuple(slice(RIM, RIM + n) for n in volume.shape)
    return np.ascontiguousarray(parts.sum(0)[inside])
