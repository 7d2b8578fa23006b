"""Conjugate gradients, and the V-cycle of a multigrid hierarchy as tensors: pyamg's own runs on the processor alone."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh
from torch import Tensor

if TYPE_CHECKING:
    from pyamg.multilevel import MultilevelSolver

Array = NDArray[np.float64]

_SWEEPS = 2  # of the smoother, before and after: Jacobi's does half as much in one as Gauss and Seidel's


def conjugate_gradients(
    matrix: Any, force: Any, precondition: Callable[[Any], Any], tolerance: float, most: int
) -> tuple[Any, float]:
    """The solution (3N,) of a positive matrix (3N, 3N), and its residual over the force.

    Matrix and force are arrays, or tensors of one device. Ends early where the matrix is not positive.
    """
    x, residual = 0.0 * force, 1.0 * force
    whole = math.sqrt(force @ force)
    if whole == 0.0:
        return x, 0.0
    direction = ready = precondition(residual)
    product = residual @ ready
    for _ in range(most):
        image = matrix @ direction
        curvature = direction @ image
        if curvature <= 0:
            break
        x += (step := product / curvature) * direction
        residual -= step * image
        if math.sqrt(residual @ residual) <= tolerance * whole:
            break
        ready = precondition(residual)
        product, before = residual @ ready, product
        direction = ready + product / before * direction
    return x, math.sqrt(residual @ residual) / whole


@dataclass(frozen=True, eq=False)
class _Level:
    """One level above the coarsest."""

    matrix: Tensor  # sparse
    damped: Tensor  # (blocks, B, B) inverse of the matrix's diagonal blocks, damped
    interpolation: Tensor  # sparse
    restriction: Tensor  # sparse


class Cycle:
    """A symmetric V-cycle, smoothed by damped block Jacobi: all rows at a time, as a GPU works."""

    def __init__(self, levels: "MultilevelSolver", device: torch.device) -> None:
        *above, coarsest = levels.levels
        self._levels = [_level(level.A, level.P, level.R, device) for level in above]
        dense = np.linalg.pinv(coarsest.A.toarray(), hermitian=True)
        self._coarsest = torch.from_numpy(dense).to(device)

    def __call__(self, residual: Tensor) -> Tensor:
        """Nearly the matrix's inverse times a residual (3N,)."""
        return self._below(0, residual)

    def _below(self, n: int, residual: Tensor) -> Tensor:
        if n == len(self._levels):
            return self._coarsest @ residual
        level = self._levels[n]
        x = _smoothed(level, torch.zeros_like(residual), residual)
        x += level.interpolation @ self._below(n + 1, level.restriction @ (residual - level.matrix @ x))
        return _smoothed(level, x, residual)


def on_device(matrix: sparse.sparray | sparse.spmatrix, device: torch.device) -> Tensor:
    """A sparse matrix as a tensor in compressed rows."""
    rows = sparse.csr_array(matrix)
    rows.sort_indices()
    starts, columns = (torch.from_numpy(part.astype(np.int64)) for part in (rows.indptr, rows.indices))
    with warnings.catch_warnings():  # such tensors are "in beta state"; products with them are tested here
        warnings.filterwarnings("ignore", message=".*beta state")
        made = torch.sparse_csr_tensor(starts, columns, torch.from_numpy(rows.data), rows.shape, check_invariants=True)
        return made.to(device)


def _smoothed(level: _Level, x: Tensor, wanted: Tensor) -> Tensor:
    size = level.damped.shape[-1]
    for _ in range(_SWEEPS):
        left = wanted - level.matrix @ x
        x = x + (level.damped @ left.view(-1, size, 1)).view(-1)
    return x


def _level(matrix: sparse.bsr_matrix, interpolation: Any, restriction: Any, device: torch.device) -> _Level:
    """A level whose smoother is damped by 4/3 over the spectral radius of D⁻¹A, D its diagonal blocks.

    With 4/3 the upper two thirds of the spectrum are damped best (Vaněk et al. 1996, Computing 56:179, there for the
    smoothing of the interpolation).
    """
    size = matrix.blocksize[0]
    blocks = _diagonal_blocks(matrix, size)
    inverse = np.asarray(np.linalg.inv(blocks), np.float64)
    damping = 4 / 3 / _largest(matrix, blocks, inverse)
    parts = (matrix, interpolation, restriction)
    sparse_parts = [on_device(part, device) for part in parts]
    return _Level(sparse_parts[0], torch.from_numpy(damping * inverse).to(device), *sparse_parts[1:])


def _diagonal_blocks(matrix: sparse.bsr_matrix, size: int) -> Array:
    """(blocks, B, B). pyamg's interpolation has a zero column where an aggregate has too few nodes; 1 stands there."""
    rows = np.repeat(np.arange(len(matrix.indptr) - 1), np.diff(matrix.indptr))
    blocks = np.zeros((len(matrix.indptr) - 1, size, size))
    on = rows == matrix.indices
    blocks[rows[on]] = matrix.data[on]
    diagonal = np.einsum("nii->ni", blocks)
    diagonal[diagonal <= 0] = 1.0
    return blocks


def _largest(matrix: sparse.bsr_matrix, blocks: Array, inverse: Array) -> float:
    """The largest eigenvalue of D⁻¹A, to a hundredth."""
    size = blocks.shape[-1]

    def times(many: Array) -> LinearOperator:
        def product(x: Array) -> Array:
            return np.asarray((many @ x.reshape(-1, size, 1)).ravel())

        return LinearOperator(matrix.shape, product, dtype=float)

    start = np.random.default_rng(0).normal(size=matrix.shape[0])  # same input, same bits
    found = eigsh(matrix, 1, times(blocks), Minv=times(inverse), tol=1e-2, v0=start, return_eigenvectors=False)
    return float(found[0])
