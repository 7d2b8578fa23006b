"""Hexahedra over a bone: which there are, their nodes, and what voxels of the CT each averages.

Properties are mapped voxel by voxel at the CT's resolution and then averaged, and elements at the surface that are
filled only in part are kept with diluted properties. Density averaged first, and whole elements at the surface, turn
the mesh size into a factor of two in what cement gains.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    overlap: tuple[Array, Array, Array]  # for each axis (B, V), mm that blocks and voxels have in common
    spacing: Array  # (3,) mm of the voxels
    lps_from_mm: Array  # (4, 4) takes mm along the index axes, from the first block's corner, to LPS

    def mean(self, values: NDArray) -> Array:
        """Averages (BX, BY, BZ) of values at voxels (X, Y, Z) over each block; what is beyond the box counts as 0."""
        x, y, z = (overlap / self.size_mm for overlap in self.overlap)
        return np.asarray(np.einsum("ax,by,cz,xyz->abc", x, y, z, np.asarray(values, float), optimize=True))

    def spread(self, values: NDArray) -> Array:
        """What blocks hold (BX, BY, BZ), at the femur's voxels (X, Y, Z)."""
        x, y, z = (overlap / edge for overlap, edge in zip(self.overlap, self.spacing, strict=True))
        return np.asarray(np.einsum("ax,by,cz,abc->xyz", x, y, z, np.asarray(values, float), optimize=True))

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
    shape, overlap = [], []
    corner = np.zeros(3)
    for axis, spacing in enumerate(femur.spacing):
        voxels = np.arange(femur.mask.shape[axis])
        count = int(np.ceil(len(voxels) * spacing / size_mm - 1e-9))
        corner[axis] = (len(voxels) * spacing - count * size_mm) / 2
        low = corner[axis] + np.arange(count)[:, None] * size_mm
        ends = np.minimum(low + size_mm, (voxels + 1) * spacing) - np.maximum(low, voxels * spacing)
        shape.append(count)
        overlap.append(np.maximum(ends, 0.0))
    affine = np.eye(4)
    affine[:3, :3] = femur.axes
    affine[:3, 3] = femur.lps_from_index[:3, 3] - femur.lps_from_index[:3, :3] @ np.full(3, 0.5) + femur.axes @ corner
    made = (overlap[0], overlap[1], overlap[2])
    return Blocks(size_mm, (shape[0], shape[1], shape[2]), made, femur.spacing, affine)


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
        """Those (E,) of block values (BX, BY, BZ) that belong to elements."""
        return np.asarray(values[tuple(self.cells.T)])

    def surface(self, direction: Array) -> Array:
        """Area (N,), mm², that each node bears of the surface which a unit vector (3,) along the index axes looks at.

        Areas are projected along the vector, so that they add up to the true projection however the voxels step.
        """
        area = np.zeros(len(self.nodes))
        taken = np.zeros(self.cells.max(0) + 3, bool)  # a rim of free blocks all around
        taken[tuple(self.cells.T + 1)] = True
        for axis in range(3):
            step = int(np.sign(direction[axis])) or 1
            share = abs(direction[axis]) * self.size_mm**2 / 4
            beside = self.cells.copy()
            beside[:, axis] += step
            free = ~taken[tuple(beside.T + 1)]
            face = CORNERS[:, axis] == (step > 0)
            np.add.at(area, self.elements[free][:, face].ravel(), share)
        return area


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
