"""Hexahedra over a bone: which there are, their nodes, and what voxels of the CT each averages.

Properties are mapped voxel by voxel at the CT's resolution and then averaged over the eighth of an element around each
Gauss point (`model.py` says how), and elements at the surface that are filled only in part are kept. Density averaged
first, and whole elements at the surface, turn the mesh size into a factor of two in what cement gains.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from femoreg_torch.errors import InputError
from femoreg_torch.planning.element import CORNERS
from femoreg_torch.planning.femur import Femur

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Cubes of `size_mm` over the box of a femur, along its index axes."""

    size_mm: float
    shape: tuple[int, int, int]
    overlap: tuple[Array, ...]  # for each axis (B, V), mm that blocks and voxels have in common
    half_overlap: tuple[Array, ...]  # (2B, V) the same of halves of blocks
    spacing: Array  # (3,) mm of the voxels
    lps_from_mm: Array  # (4, 4) takes mm along the index axes, from the first block's corner, to LPS

    def mean(self, values: NDArray) -> Array:
        """Averages (BX, BY, BZ) of values at voxels (X, Y, Z) over each block; what is beyond the box counts as 0."""
        return _mean(self.overlap, self.size_mm, values)

    def octants(self, values: NDArray) -> Array:
        """Averages (BX, BY, BZ, 8) over the eighths of each block, in the order of the corners of an element."""
        a, b, c = self.shape
        means = _mean(self.half_overlap, self.size_mm / 2, values).reshape(a, 2, b, 2, c, 2)
        return np.asarray(means.transpose(0, 2, 4, 1, 3, 5).reshape(a, b, c, 8))

    def spread(self, values: NDArray) -> Array:
        """What blocks hold (BX, BY, BZ), at the femur's voxels (X, Y, Z)."""
        return _spread(self.overlap, self.spacing, values)

    def spread_octants(self, values: NDArray) -> Array:
        """The same of what their eighths hold (BX, BY, BZ, 8)."""
        a, b, c = self.shape
        apart = np.asarray(values).reshape(a, b, c, 2, 2, 2).transpose(0, 3, 1, 4, 2, 5).reshape(2 * a, 2 * b, 2 * c)
        return _spread(self.half_overlap, self.spacing, apart)

    def around(self, voxels: NDArray[np.bool_]) -> tuple["Blocks", Ints, tuple[slice, ...]]:
        """The box of blocks that meets some voxels (X, Y, Z), its first block (3,), and the box of voxels it meets."""
        firsts, parts, halves, boxes = [], [], [], []
        for axis, (overlap, half) in enumerate(zip(self.overlap, self.half_overlap, strict=True)):
            there = voxels.any(tuple(other for other in range(3) if other != axis))
            rows = _extent(overlap[:, there])
            box = _extent(overlap[rows].T)
            firsts.append(rows.start)
            parts.append(overlap[rows, box])
            halves.append(half[2 * rows.start : 2 * rows.stop, box])
            boxes.append(box)
        first = np.array(firsts)
        affine = self.lps_from_mm.copy()
        affine[:3, 3] = self.lps((first * self.size_mm)[None])[0]
        a, b, c = (len(part) for part in parts)
        return Blocks(self.size_mm, (a, b, c), tuple(parts), tuple(halves), self.spacing, affine), first, tuple(boxes)

    def centres(self, index: Ints) -> Array:
        """Middles (N, 3), LPS mm, of blocks (N, 3)."""
        return self.lps(np.asarray((index + 0.5) * self.size_mm, float))

    def index(self, point: Array) -> Array:
        """Fractional index (3,) of a point (3,), LPS mm; whole in the middles of blocks."""
        mm = np.linalg.solve(self.lps_from_mm[:3, :3], point - self.lps_from_mm[:3, 3])
        return np.asarray(mm / self.size_mm - 0.5)

    def lps(self, mm: Array) -> Array:
        """Points (N, 3), LPS mm, from mm along the index axes."""
        return np.asarray(mm @ self.lps_from_mm[:3, :3].T + self.lps_from_mm[:3, 3])


def blocks(femur: Femur, size_mm: float) -> Blocks:
    """Blocks of some edge over a femur, as far beyond its box on one side as on the other.

    So the blocks of a mirrored femur are the mirrored blocks.
    """
    extent = np.array(femur.mask.shape) * femur.spacing
    count = np.ceil(extent / size_mm - 1e-9).astype(int)
    corner = (extent - count * size_mm) / 2
    affine = np.eye(4)
    affine[:3, :3] = femur.axes
    affine[:3, 3] = femur.lps_from_index[:3, 3] - femur.lps_from_index[:3, :3] @ np.full(3, 0.5) + femur.axes @ corner
    overlap, half_overlap = (
        tuple(
            _overlap(corner[axis], parts * int(count[axis]), size_mm / parts, femur.mask.shape[axis], spacing)
            for axis, spacing in enumerate(femur.spacing)
        )
        for parts in (1, 2)
    )
    return Blocks(size_mm, tuple(count.tolist()), overlap, half_overlap, femur.spacing, affine)


def _mean(overlap: tuple[Array, ...], size_mm: float, values: NDArray) -> Array:
    x, y, z = (part / size_mm for part in overlap)
    return np.asarray(np.einsum("ax,by,cz,xyz->abc", x, y, z, np.asarray(values, float), optimize=True))


def _spread(overlap: tuple[Array, ...], spacing: Array, values: NDArray) -> Array:
    x, y, z = (part / edge for part, edge in zip(overlap, spacing, strict=True))
    return np.asarray(np.einsum("ax,by,cz,abc->xyz", x, y, z, np.asarray(values, float), optimize=True))


def _extent(overlap: Array) -> slice:
    """From the first to the last row of (N, M) with anything in it."""
    found = np.flatnonzero(overlap.sum(1))
    return slice(int(found[0]), int(found[-1]) + 1)


def _overlap(corner: float, count: int, size_mm: float, voxels: int, spacing: float) -> Array:
    """mm (B, V) that blocks in a row, from a corner on, have in common with voxels in a row from 0 on."""
    low, start = corner + np.arange(count)[:, None] * size_mm, np.arange(voxels) * spacing
    return np.maximum(np.minimum(low + size_mm, start + spacing) - np.maximum(low, start), 0.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Elements and nodes. Displacements are along the index axes of the CT; `axes` takes them to LPS."""

    size_mm: float
    cells: Ints  # (E, 3) which block each element is
    elements: Ints  # (E, 8) nodes
    nodes: Array  # (N, 3) mm along the index axes
    axes: Array  # (3, 3) unit vectors of the index axes in LPS, as columns
    origin: Array  # (3,) LPS mm of the box's corner

    @property
    def points(self) -> Array:
        """Nodes (N, 3), LPS mm."""
        return np.asarray(self.nodes @ self.axes.T + self.origin)

    @property
    def centres(self) -> Array:
        """Middles of the elements (E, 3), LPS mm."""
        return np.asarray((self.cells + 0.5) * self.size_mm @ self.axes.T + self.origin)

    def of(self, values: Array) -> Array:
        """Those (E, ...) of block values (BX, BY, BZ, ...) that belong to elements."""
        return np.asarray(values[tuple(self.cells.T)])

    def shared(self, points: Array, amounts: Array) -> Array:
        """Amounts (M,) at points (M, 3), LPS mm, shared out to the nodes (N,) by the shape functions of their elements.

        What lies beside the mesh goes to the nearest element, or in equal parts to those that are alike near, so that a
        mirrored mesh shares alike. Sums stay, and within the mesh first moments too.
        """
        places = (points - self.origin) @ self.axes / self.size_mm
        distance, nearest = cKDTree(self.cells + 0.5).query(places, k=min(8, len(self.cells)))
        near = distance <= distance[:, :1] + 1e-6
        point, number = np.nonzero(near)
        element = nearest[point, number]
        within = np.clip(places[point] - self.cells[element], 0.0, 1.0)
        shares = np.stack([np.where(corner, within, 1 - within).prod(1) for corner in CORNERS], axis=1)
        shares *= (amounts / near.sum(1))[point, None]
        return np.asarray(np.bincount(self.elements[element].ravel(), shares.ravel(), len(self.nodes)), float)


def mesh_of(size_mm: float, kept: NDArray[np.bool_], axes: Array, origin: Array) -> Mesh:
    """The mesh of the blocks (BX, BY, BZ) that are kept."""
    cells = np.argwhere(kept)
    corner = cells[:, None, :] + CORNERS[None]
    shape = np.array(kept.shape) + 1
    number = np.ravel_multi_index(tuple(corner.reshape(-1, 3).T), tuple(shape))
    unique, elements = np.unique(number, return_inverse=True)
    nodes = np.stack(np.unravel_index(unique, tuple(shape)), axis=1) * size_mm
    return Mesh(size_mm, cells, elements.reshape(-1, 8), nodes.astype(float), axes, origin)


def too_many(count: int, most: int, size_mm: float) -> None:
    """Raises `InputError` for more elements than memory is meant for."""
    if count > most:
        raise InputError(
            f"mesh.size_mm: {size_mm:g} makes {count} elements, more than {most} (mesh.most_elements). Use larger ones."
        )
