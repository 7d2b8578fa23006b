"""The one element of a voxel mesh: a cube with eight nodes, eight Gauss points and mean dilatation (B-bar).

All cubes have the same shape, so all matrices here are those of one cube of edge 1 and modulus 1, and a mesh scales
them. Strains and stresses are in the order xx, yy, zz, yz, xz, xy, shear strains as engineers' (twice the tensor's).
Source: Hughes, "The Finite Element Method" (1987), section 4.5, of selective integration by B-bar.
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])  # (8, 3) of a cube of edge 1
TENSOR = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])  # engineers' strains to those of the tensor
_NORMAL = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Template:
    """Matrices of the cube of edge 1. Degrees of freedom are node by node, x, y, z."""

    dilatation: Array  # (24,) mean volumetric strain of the cube by displacements
    deviator: Array  # (8, 6, 24) deviatoric strain at each Gauss point by displacements
    volumetric: Array  # (24, 24) stiffness for a bulk modulus of 1
    shear: Array  # (8, 24, 24) stiffness of each Gauss point for a shear modulus of 1; they add up


@functools.cache
def template() -> Template:
    """The matrices; made once."""
    gauss = 0.5 + (CORNERS - 0.5) / np.sqrt(3)
    strain = np.stack([_strain(point) for point in gauss])
    dilatation = np.einsum("i,gij->j", _NORMAL, strain) / 8
    deviator = strain - _NORMAL[None, :, None] * np.einsum("i,gij->gj", _NORMAL, strain)[:, None, :] / 3
    shear = 2 * np.einsum("gij,i,gik->gjk", deviator, TENSOR, deviator) / 8
    return Template(dilatation, deviator, np.outer(dilatation, dilatation), shear)


def moduli(poisson: float) -> tuple[float, float]:
    """Bulk and shear modulus for a Young's modulus of 1."""
    return 1 / (3 * (1 - 2 * poisson)), 1 / (2 * (1 + poisson))


def elastic_stiffness(modulus: Array, poisson: float) -> Array:
    """Stiffness (E, 24, 24) of cubes of edge 1, Young's moduli (E, 8) at their Gauss points; edge h: h times it."""
    bulk, shear = moduli(poisson)
    return stiffness(bulk * modulus, shear * modulus)


def stiffness(bulk: Array, shear: Array) -> Array:
    """The same, for bulk and shear moduli (E, 8).

    Dilatation is the same in the whole cube, so its stiffness is that of the mean bulk modulus.
    """
    made = template()
    found = shear @ made.shear.reshape(8, 576) + bulk.mean(1)[:, None] * made.volumetric.reshape(1, 576)
    return np.asarray(found.reshape(-1, 24, 24))


def _strain(point: Array) -> Array:
    """Strain (6, 24) at a point (3,) of the cube of edge 1 by displacements."""
    sign = 2 * CORNERS - 1
    value = np.where(CORNERS == 1, point, 1 - point)
    matrix = np.zeros((6, 8, 3))
    for axis in range(3):
        slope = sign[:, axis] * np.prod(np.delete(value, axis, 1), axis=1)
        matrix[axis, :, axis] = slope
        for row, pair in zip((3, 4, 5), ((1, 2), (0, 2), (0, 1)), strict=True):
            if axis in pair:
                other = pair[0] if axis == pair[1] else pair[1]
                matrix[row, :, other] = slope
    return matrix.reshape(6, 24)
