"""Shadows of bone surfaces seen from far away, and what can be read from them."""

import math

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MARGIN_MM = 3.0


def silhouette(points2: Points, faces: NDArray[np.int64], pixel_mm: float, edge_mm: float) -> tuple[Mask, Points]:
    """Filled shadow of a mesh whose vertices project to `points2` (V, 2) mm, and the place (2,) of pixel (0, 0).

    Triangles with edges up to `edge_mm` are sampled so densely that no pixel within is missed.
    """
    origin = points2.min(0) - _MARGIN_MM
    image = np.zeros(np.ceil((points2.max(0) + _MARGIN_MM - origin) / pixel_mm).astype(int), bool)
    a, b, c = (points2[faces[:, k]] for k in range(3))
    samples = math.ceil(edge_mm / pixel_mm)  # along each side
    for i in range(samples + 1):
        for j in range(samples + 1 - i):
            sample = (a * i + b * j + c * (samples - i - j)) / samples
            image[tuple(((sample - origin) / pixel_mm).astype(int).T)] = True
    return ndimage.binary_closing(image, iterations=2), origin


def largest_hole(image: Mask) -> tuple[Mask, float]:
    """The largest part of the background that is not the outside, and its pixels."""
    parts, count = ndimage.label(~image)
    size = ndimage.sum(~image, parts, range(1, count + 1))
    size[parts[0, 0] - 1] = 0
    return parts == size.argmax() + 1, float(size.max())


def convex_hull(image: Mask) -> Mask:
    """Filled convex hull of an image."""
    pixels = np.argwhere(image)
    corners = np.concatenate([pixels + shift for shift in ((-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))])
    planes = ConvexHull(corners).equations
    i, j = np.indices(image.shape)
    inside = planes[:, 0, None, None] * i + planes[:, 1, None, None] * j + planes[:, 2, None, None] < 1e-9
    hull: Mask = np.all(inside, axis=0)
    return hull


def vertex_behind(mesh: trimesh.Trimesh, points2: Points, place: Points, tolerance_mm: float) -> Points:
    """The vertex (3,) behind a place (2,) on the silhouette's edge: the middle one of those that project near it."""
    distance = np.linalg.norm(points2 - place, axis=1)
    near = mesh.vertices[distance < max(tolerance_mm, distance.min() + 0.3)]
    vertex: Points = near[np.linalg.norm(near - np.median(near, axis=0), axis=1).argmin()]
    return vertex
