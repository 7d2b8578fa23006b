"""A volume: numbers on a regular grid in patient space (or, for a device, in CAD space)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError


@dataclass(frozen=True, eq=False)  # compared and hashed by identity, so that back ends can cache what they derive
class Volume:
    """Values `data` (Z, Y, X), indexed [z, y, x], voxel centres at integers.

    `lps_from_index` (4, 4) float64 maps (x, y, z) indices to mm: LPS for a CT, CAD axes for a device.
    """

    data: Tensor
    lps_from_index: Tensor

    def __post_init__(self) -> None:
        if self.data.ndim != 3:
            raise InputError(f"volume: data must be (Z, Y, X), got shape {tuple(self.data.shape)}.")
        if self.lps_from_index.shape != (4, 4) or self.lps_from_index.dtype != torch.float64:
            raise InputError("volume: lps_from_index must be a 4×4 float64 tensor.")

    @property
    def spacing_mm(self) -> tuple[float, float, float]:
        """Voxel size along x, y, z."""
        x, y, z = self.lps_from_index[:3, :3].norm(dim=0).tolist()
        return x, y, z

    def centre(self) -> Tensor:
        """Middle of the grid (3,), mm, half-way between the outermost voxel centres."""
        last = torch.tensor(self.data.shape[::-1], dtype=torch.float64) - 1
        return self.lps_from_index[:3, :3] @ (last / 2) + self.lps_from_index[:3, 3]

    def beyond_mm(self, point: Tensor) -> float:
        """How far a point (3,), mm, lies outside the box of all voxels; 0 inside."""
        spacing = torch.tensor(self.spacing_mm, dtype=torch.float64)
        half = torch.tensor(self.data.shape[::-1]) * spacing / 2
        along = (self.lps_from_index[:3, :3] / spacing).T @ (point - self.centre())
        return (along.abs() - half).clamp_min(0).norm().item()

    def with_data(self, data: Tensor) -> "Volume":
        """Other values on the same grid."""
        if data.shape != self.data.shape:
            raise InputError(f"volume: {tuple(data.shape)} values do not fit a {tuple(self.data.shape)} grid.")
        return Volume(data, self.lps_from_index)

    def to(self, device: torch.device) -> "Volume":
        """The same with its values on a device; the volume itself if they lie there. The affine stays on the CPU."""
        data = self.data.to(device)
        return self if data is self.data else Volume(data, self.lps_from_index)


def changes_in_place(data: Tensor) -> int:
    """How often a tensor was changed in place, for what is derived from it; 0 for one that does not count that.

    Tensors made under `torch.inference_mode` do not.
    """
    return 0 if data.is_inference() else data._version


def axis_aligned(spacing_mm: tuple[float, float, float], origin_mm: tuple[float, float, float]) -> Tensor:
    """`lps_from_index` (4, 4) of a grid along the axes; the origin is the centre of the first voxel."""
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = torch.diag(torch.tensor(spacing_mm, dtype=torch.float64))
    affine[:3, 3] = torch.tensor(origin_mm, dtype=torch.float64)
    return affine
