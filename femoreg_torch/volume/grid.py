"""A volume: numbers on a regular grid in patient space (or, for a device, in CAD space)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points

# Edges of voxels and places, mm. Far beyond what is scanned, and so that indices and mm can be told in float64.
_VOXEL_MM = (1e-6, 1e6)
_FARTHEST_MM = 1e9
_LEAST_DETERMINANT = 1e-6  # of the three unit axes: 1 where they are square to each other, 0 in one plane
_LAST_ROW, _ROUNDING = (0.0, 0.0, 0.0, 1.0), 1e-9


@dataclass(frozen=True, eq=False)  # compared and hashed by identity, so that back ends can cache what they derive
class Volume:
    """Values `data` (Z, Y, X), indexed [z, y, x], voxel centres at integers.

    `lps_from_index` (4, 4) float64 maps (x, y, z) indices to mm: LPS for a CT, CAD axes for a device. It lies on the
    CPU wherever the data are. Raises `InputError` for one that is not finite or that no grid of voxels has.
    """

    data: Tensor
    lps_from_index: Tensor

    def __post_init__(self) -> None:
        if not isinstance(self.data, Tensor):
            raise InputError(
                f"volume: data must be a torch tensor, got {type(self.data).__name__}. Use torch.from_numpy."
            )
        if self.data.ndim != 3:
            raise InputError(f"volume: data must be (Z, Y, X), got shape {tuple(self.data.shape)}.")
        if self.data.is_complex():
            raise InputError("volume: data must be real, got complex numbers. Take their .real or .abs().")
        affine = self.lps_from_index
        if not isinstance(affine, Tensor) or affine.shape != (4, 4) or affine.dtype != torch.float64:
            raise InputError("volume: lps_from_index must be a 4×4 float64 tensor.")
        if affine.device.type != "cpu":
            raise InputError(f"volume: lps_from_index lies on {affine.device}; it belongs on the CPU, call .cpu().")
        _check_affine(affine.tolist())

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

    def points_above(self, least: float, most: int) -> Tensor:
        """Centres (N, 3) of voxels with more than `least`, mm, on the CPU: every n-th, so that at most `most`."""
        places = (self.data > least).nonzero()
        places = places[:: 1 + len(places) // most].cpu()
        return transform_points(self.lps_from_index, places.flip(1).double())

    def with_data(self, data: Tensor) -> "Volume":
        """Other values (Z, Y, X) on the same grid. Raises `InputError` for another shape."""
        if data.shape != self.data.shape:
            raise InputError(f"volume: {tuple(data.shape)} values do not fit a {tuple(self.data.shape)} grid.")
        return Volume(data, self.lps_from_index)

    def to(self, device: torch.device) -> "Volume":
        """The same with its values on a device; the volume itself if they lie there. The affine stays on the CPU."""
        data = self.data.to(device)
        return self if data is self.data else Volume(data, self.lps_from_index)


def _check_affine(rows: list[list[float]]) -> None:
    """Raise `InputError` for a `lps_from_index` (4 rows) of no grid. In plain Python, for it is a few numbers."""
    if not all(math.isfinite(value) for row in rows for value in row):
        raise InputError("volume: lps_from_index holds values that are not finite.")
    if any(abs(found - wanted) > _ROUNDING for found, wanted in zip(rows[3], _LAST_ROW, strict=True)):
        raise InputError(f"volume: the last row of lps_from_index must be 0, 0, 0, 1, got {rows[3]}.")
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = rows
    edges = math.hypot(a, d, g), math.hypot(b, e, h), math.hypot(c, f, i)
    if min(edges) < _VOXEL_MM[0] or max(edges) > _VOXEL_MM[1]:
        told = " × ".join(f"{edge:.3g}" for edge in edges)
        raise InputError(
            f"volume: its voxels have edges of {told} mm, expected between {_VOXEL_MM[0]:g} and {_VOXEL_MM[1]:g} mm. "
            "Give lps_from_index in mm."
        )
    if max(abs(x), abs(y), abs(z)) > _FARTHEST_MM:
        raise InputError(
            f"volume: its first voxel lies at {x:.3g}, {y:.3g}, {z:.3g} mm, farther than {_FARTHEST_MM:g} mm."
        )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if abs(determinant) < _LEAST_DETERMINANT * math.prod(edges):
        raise InputError("volume: the axes of lps_from_index lie in one plane, so it has no inverse.")


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
