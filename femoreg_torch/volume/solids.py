"""A device of several solids, each of its own material, as volumes on one grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume.attenuation import hu_to_attenuation
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.mesh import empty_grid, mesh_share
from femoreg_torch.volume.mesh_files import bounds_of

if TYPE_CHECKING:
    import trimesh

_AIR_HU = -1000.0
_LEAST_LEFT = 0.01  # of a solid, beside those that replace it


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid in the space of its device: a closed mesh in mm, or the share of each voxel that it fills."""

    shape: "trimesh.Trimesh | Volume"
    hu: float
    name: str  # in messages


def solid_volumes(solids: Sequence[Solid], spacing_mm: float) -> tuple[Volume, ...]:
    """Attenuation (1/mm) of each solid, on one grid of cubic voxels that holds all of them. HU count from air.

    Where solids overlap, a later one replaces those before it, so that no voxel is filled more than once. Raises
    `InputError` for a solid of which nothing is left, and for meshes that are too small or too large for a device.
    """
    grid = empty_grid(_bounds(solids), spacing_mm)
    free = torch.ones_like(grid.data)
    volumes: list[Volume] = []
    shares: list[Tensor] = []
    for solid in reversed(solids):
        share = _share(solid.shape, grid)
        if any(torch.equal(share, later) for later in shares):
            raise InputError(f"{solid.name}: a later part has the same shape at the same place. Name each part once.")
        shares.append(share)
        kept = torch.minimum(share, free)
        if kept.sum() <= _LEAST_LEFT * share.sum():
            raise InputError(f"{solid.name}: later parts fill all of its space and replace it. Name it after them.")
        free = free - kept
        volumes.append(grid.with_data(kept * hu_to_attenuation(torch.tensor(float(solid.hu)), _AIR_HU)))
    return tuple(reversed(volumes))


def _bounds(solids: Sequence[Solid]) -> np.ndarray:
    """The lowest and the highest corner (2, 3) of all solids, mm."""
    corners = [_corners(solid.shape) for solid in solids if isinstance(solid.shape, Volume)]
    meshes = [solid.shape for solid in solids if not isinstance(solid.shape, Volume)]
    if meshes:
        corners.append(bounds_of(meshes, solids[0].name))
    every = np.concatenate(corners)
    return np.stack([every.min(0), every.max(0)])


def _corners(volume: Volume) -> np.ndarray:
    """The eight outermost voxel centres (8, 3), mm."""
    last = (torch.tensor([0.0, n - 1], dtype=torch.float64) for n in reversed(volume.data.shape))
    return transform_points(volume.lps_from_index, torch.cartesian_prod(*last)).numpy()


def _share(shape: "trimesh.Trimesh | Volume", grid: Volume) -> Tensor:
    """How much of each voxel of the grid (Z, Y, X) the solid fills."""
    if not isinstance(shape, Volume):
        return mesh_share(shape, grid)
    index = (torch.linalg.inv(shape.lps_from_index) @ grid.lps_from_index).numpy()  # of the solid from that of the grid
    sampled = ndimage.affine_transform(
        shape.data.numpy(), index[:3, :3][::-1, ::-1], index[:3, 3][::-1], grid.data.shape, order=1
    )
    return torch.from_numpy(sampled)
