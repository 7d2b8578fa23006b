"""Paths of rays through closed meshes, exact: where each ray crosses the surface, told by shadows of its triangles.

A ray's path through a solid is the sum of its distances where it leaves the surface, less those where it enters it.
Each triangle is drawn on the detector, as graphics cards draw them, and adds its distances to the pixels in its shadow,
so that no ray looks for the triangles that it meets. Nothing is sampled: edges are as sharp as the mesh, and metal
thinner than a voxel keeps its thickness.
"""

import math

import numba
import numpy as np
import torch
import trimesh
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, project_points, transform_points


def mesh_paths(mesh: trimesh.Trimesh, camera_from_mesh: Tensor, camera: Camera) -> Tensor:
    """Lengths (H, W) in mm, float32, of the rays through the middles of pixels within a closed mesh in mm.

    Args:
        mesh: watertight, its normals outwards.
        camera_from_mesh: (4, 4).
        camera: with the source at its origin. All of the mesh lies in front of it.

    Raises:
        InputError: for a mesh that reaches behind the source.
    """
    vertices = transform_points(camera_from_mesh, torch.from_numpy(np.array(mesh.vertices, np.float64)))
    if float(vertices[:, 2].min()) <= 0:
        raise InputError("X-rays: the device or the table reaches behind the source. Check its size and its pose.")
    pixels = project_points(camera, vertices).numpy()  # (V, 2) column, row
    detector = np.array([camera.sdd_mm, *camera.pixel_mm, *camera.principal_point_px])
    paths = np.zeros(camera.shape)
    _add_distances(pixels, 1 / vertices[:, 2].numpy(), np.array(mesh.faces), detector, paths)
    return torch.from_numpy(paths).float()


@numba.njit(cache=True, nogil=True)
def _add_distances(pixels, nearness, faces, detector, paths):  # type: ignore[no-untyped-def]
    """Add the distances of faces that look away from the source, and take off those of faces that look towards it.

    `nearness`, one per depth, is linear on the shadow of a face. A pixel on the shadow of an edge belongs to one of the
    two faces there, or where they fold over to both or none: so each ray leaves as often as it enters.
    """
    rows, columns = paths.shape
    sdd, height, width, middle_column, middle_row = detector
    for face in range(len(faces)):
        a, b, c = faces[face]
        area = _side(pixels, a, b, pixels[c, 0], pixels[c, 1])
        if area == 0.0:
            continue
        away = 1.0
        if area < 0.0:
            away = -1.0
            b, c = c, b
        top = max(0, math.ceil(min(pixels[a, 1], pixels[b, 1], pixels[c, 1])))
        bottom = min(rows - 1, math.floor(max(pixels[a, 1], pixels[b, 1], pixels[c, 1])))
        for row in range(top, bottom + 1):
            left, right = np.inf, -np.inf
            for one, other in ((a, b), (b, c), (c, a)):
                low, high = _columns(pixels, one, other, row)
                left, right = min(left, low), max(right, high)
            y = (row - middle_row) * height / sdd
            for column in range(max(0, math.floor(left)), min(columns - 1, math.ceil(right)) + 1):
                of_a = _side(pixels, b, c, column, row)
                of_b = _side(pixels, c, a, column, row)
                of_c = _side(pixels, a, b, column, row)
                inside = (
                    (of_a > 0.0 or (of_a == 0.0 and _first(pixels, b, c)))
                    and (of_b > 0.0 or (of_b == 0.0 and _first(pixels, c, a)))
                    and (of_c > 0.0 or (of_c == 0.0 and _first(pixels, a, b)))
                )
                if inside:
                    near = of_a * nearness[a] + of_b * nearness[b] + of_c * nearness[c]
                    x = (column - middle_column) * width / sdd
                    depth = (of_a + of_b + of_c) / near
                    paths[row, column] += away * depth * math.sqrt(1.0 + x * x + y * y)


@numba.njit(cache=True, nogil=True)
def _columns(pixels, one, other, row):  # type: ignore[no-untyped-def]
    """From which to which column an edge crosses a row, but for rounding; none if it does not."""
    ax, ay, bx, by = pixels[one, 0], pixels[one, 1], pixels[other, 0], pixels[other, 1]
    if min(ay, by) > row or max(ay, by) < row:
        return np.inf, -np.inf
    if ay == by:
        return min(ax, bx), max(ax, bx)
    x = ax + (row - ay) / (by - ay) * (bx - ax)
    return x, x


@numba.njit(cache=True, nogil=True)
def _first(pixels, one, other):  # type: ignore[no-untyped-def]
    """Whether a vertex's shadow comes before another's, by column and then by row."""
    return pixels[one, 0] < pixels[other, 0] or (
        pixels[one, 0] == pixels[other, 0] and pixels[one, 1] < pixels[other, 1]
    )


@numba.njit(cache=True, nogil=True)
def _side(pixels, one, other, x, y):  # type: ignore[no-untyped-def]
    """On which side of an edge a point lies, times the edge's length; exactly the opposite for the edge turned."""
    sign = 1.0
    if not _first(pixels, one, other):
        one, other, sign = other, one, -1.0
    across = (pixels[other, 0] - pixels[one, 0]) * (y - pixels[one, 1])
    return sign * (across - (pixels[other, 1] - pixels[one, 1]) * (x - pixels[one, 0]))
