"""The equations of a mesh: assembly, and conjugate gradients with algebraic multigrid."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from femoreg_torch.errors import InputError
from femoreg_torch.planning.mesh import Mesh
from femoreg_torch.planning.multigrid import Cycle, conjugate_gradients, on_device

Array = NDArray[np.float64]

_CHUNK = 16384  # elements assembled at a time, so that their matrices stay below 100 MB
_MOST_CG = 400


class Assembler:
    """Element matrices (E, 24, 24) into a sparse matrix of 3 × 3 blocks, whose pattern is found once."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        count = len(mesh.nodes)
        key = (mesh.elements[:, :, None] * count + mesh.elements[:, None, :]).ravel()
        unique, place = np.unique(key, return_inverse=True)
        self._place = place.reshape(-1, 8, 8)
        row, self._column = np.divmod(unique, count)
        self._start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=count))])
        self._diagonal = np.flatnonzero(row == self._column)  # in the order of the nodes
        self.freedoms = mesh.elements[:, :, None] * 3 + np.arange(3)

    def gather(self, displacement: Array) -> Array:
        """Displacements (E, 24) of the elements, of nodes' (N, 3)."""
        return np.asarray(displacement[self.mesh.elements].reshape(-1, 24))

    def scatter(self, force: Array) -> Array:
        """Nodes' forces (N, 3), sums of the elements' (E, 24)."""
        flat = np.bincount(self.freedoms.ravel(), force.ravel(), minlength=3 * len(self.mesh.nodes))
        return np.asarray(flat.reshape(-1, 3))

    def matrix(self, stiffness: Array, springs: Array) -> sparse.bsr_array:
        """The matrix (3N, 3N) of element matrices (E, 24, 24) and springs (N, 3, 3)."""
        blocks = np.zeros((len(self._column), 9))
        for first in range(0, len(self.mesh.elements), _CHUNK):
            part = slice(first, first + _CHUNK)
            split = stiffness[part].reshape(-1, 8, 3, 8, 3).transpose(0, 1, 3, 2, 4).reshape(-1, 9)
            place = self._place[part].ravel()
            for n in range(9):
                blocks[:, n] += np.bincount(place, split[:, n], minlength=len(blocks))
        blocks[self._diagonal] += springs.reshape(-1, 9)
        size = 3 * len(self.mesh.nodes)
        return sparse.bsr_array((blocks.reshape(-1, 3, 3), self._column, self._start), shape=(size, size))


class Solver:
    """Conjugate gradients, preconditioned by the smoothed aggregation of an elastic matrix that is set up once."""

    def __init__(self, elastic: sparse.bsr_array, points: Array, device: torch.device) -> None:
        import pyamg

        matrix = sparse.bsr_matrix(elastic)
        # float32 index arrays would do, but pyamg wants them as int32
        matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
        before, after = (("block_gauss_seidel", {"sweep": sweep}) for sweep in ("forward", "backward"))  # symmetric
        state = np.random.get_state()  # noqa: NPY002 - pyamg estimates spectral radii from numpy's global generator
        np.random.seed(0)  # noqa: NPY002 - same input, same bits
        try:
            levels = pyamg.smoothed_aggregation_solver(
                matrix, B=rigid_modes(points), max_coarse=300, presmoother=before, postsmoother=after
            )
        finally:
            np.random.set_state(state)  # noqa: NPY002
        self._device = None if device.type == "cpu" else device
        self._cycle: Callable[[Any], Any] = (
            levels.aspreconditioner(cycle="V").matvec if self._device is None else Cycle(levels, self._device)
        )

    def solve(self, matrix: sparse.bsr_array, force: Array, tolerance: float) -> Array:
        """Displacements (3N,) under forces (3N,). Raises `InputError` where the iteration does not converge."""
        if self._device is None:
            found, left = conjugate_gradients(matrix, force, self._cycle, tolerance, _MOST_CG)
        else:
            there = on_device(matrix, self._device), torch.from_numpy(force).to(self._device)
            moved, left = conjugate_gradients(*there, self._cycle, tolerance, _MOST_CG)
            found = moved.cpu().numpy()
        if left > 1e3 * tolerance:
            raise InputError(
                f"solver: {_MOST_CG} iterations left a residual of {left:.1e} of the load. The bone hangs together by "
                "almost nothing: check label and calibration, or use smaller steps (curve.step_mm)."
            )
        return np.asarray(found)


def rigid_modes(points: Array) -> Array:
    """The six rigid motions (3N, 6) of nodes (N, 3), about their middle."""
    x, y, z = (points - points.mean(0)).T
    modes = np.zeros((len(points), 3, 6))
    modes[:, [0, 1, 2], [0, 1, 2]] = 1
    modes[:, 1, 3], modes[:, 2, 3] = -z, y
    modes[:, 2, 4], modes[:, 0, 4] = -x, z
    modes[:, 0, 5], modes[:, 1, 5] = -y, x
    return modes.reshape(-1, 6)
