"""The pinhole camera of a flat-panel C-arm. Everything about pixel ↔ mm stands here and nowhere else.

Camera frame: origin at the X-ray source, +x along detector columns, +y along rows, +z towards the detector (as in
OpenCV), mm. The centre of the first pixel is at (column, row) = (0, 0).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.errors import InputError, shortened

# Far beyond any detector (a beam that is nearly parallel has a source 1e6 mm away), and safe to square in float64.
_LARGEST = {"sdd_mm": 1e9, "pixel_mm": 1e6, "principal_point_px": 1e9}
_SMALLEST_MM = 1e-6


@dataclass(frozen=True)
class CameraChange:
    """How a camera differs from what a C-arm's file says, on whatever grid of pixels."""

    sdd_factor: float = 1.0
    principal_point_shift_mm: tuple[float, float] = (0.0, 0.0)  # on the detector, along columns and rows

    def then(self, other: "CameraChange") -> "CameraChange":
        """Both, one after the other."""
        (x, y), (dx, dy) = self.principal_point_shift_mm, other.principal_point_shift_mm
        return CameraChange(self.sdd_factor * other.sdd_factor, (x + dx, y + dy))


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one detector (or of a window or coarser grid on it).

    Raises `InputError` for lengths that are not positive, for values that are not finite, or of an order of magnitude
    that no detector has, and for a shape that is not two whole numbers.
    """

    sdd_mm: float  # source to detector
    pixel_mm: tuple[float, float]  # row spacing, column spacing
    shape: tuple[int, int]  # rows, columns
    principal_point_px: tuple[float, float]  # column, row where the central ray meets the detector

    def __post_init__(self) -> None:
        for pair in ("pixel_mm", "shape", "principal_point_px"):
            if len(getattr(self, pair)) != 2:
                raise InputError(f"camera: {pair} must be two numbers, got {shortened(getattr(self, pair))}.")
        if not all(_is_whole(n) for n in self.shape):
            raise InputError(f"camera: shape must be two whole numbers, rows and columns, got {shortened(self.shape)}.")
        if not self.sdd_mm > 0 or not min(self.pixel_mm) > 0 or min(self.shape) < 1:
            raise InputError(f"camera: source distance, pixel size and shape must be positive, got {self}.")
        _check_size("sdd_mm", (self.sdd_mm,), _SMALLEST_MM)
        _check_size("pixel_mm", self.pixel_mm, _SMALLEST_MM)
        _check_size("principal_point_px", self.principal_point_px, 0)

    @property
    def mean_pixel_mm(self) -> float:
        """Edge of a square pixel with the same area, on the detector."""
        return math.sqrt(self.pixel_mm[0] * self.pixel_mm[1])

    def changed(self, change: CameraChange) -> "Camera":
        """The same grid of pixels seen from another source."""
        x, y = change.principal_point_shift_mm
        column, row = self.principal_point_px
        return replace(
            self,
            sdd_mm=self.sdd_mm * change.sdd_factor,
            principal_point_px=(column + x / self.pixel_mm[1], row + y / self.pixel_mm[0]),
        )

    def downsampled(self, factor: int) -> "Camera":
        """The camera of an image averaged over `factor` × `factor` blocks: c' = (c + 0.5) / factor − 0.5.

        Rows and columns that fill no whole block at the far edge are dropped, as the average drops them. Raises
        `InputError` for a factor that is no whole number from 1 on, or of which no block fits.
        """
        if not _is_whole(factor) or factor < 1:
            raise InputError(
                f"camera: blocks of a whole number of pixels were expected, 1 or more, got {shortened(factor)}."
            )
        if factor > min(self.shape):
            raise InputError(f"camera: no block of {factor} × {factor} pixels fits on a {self.shape} detector.")
        rows, columns = self.shape
        return replace(
            self,
            pixel_mm=(self.pixel_mm[0] * factor, self.pixel_mm[1] * factor),
            shape=(rows // factor, columns // factor),
            principal_point_px=(
                (self.principal_point_px[0] + 0.5) / factor - 0.5,
                (self.principal_point_px[1] + 0.5) / factor - 0.5,
            ),
        )

    def window(self, rows: slice, columns: slice) -> "Camera":
        """The camera of `image[rows, columns]`; a step in the slices samples every step-th pixel without averaging."""
        r0, r1, dr = rows.indices(self.shape[0])
        c0, c1, dc = columns.indices(self.shape[1])
        if dr < 1 or dc < 1 or r1 <= r0 or c1 <= c0:
            raise InputError(f"camera: window rows {rows}, columns {columns} is empty on a {self.shape} detector.")
        return replace(
            self,
            pixel_mm=(self.pixel_mm[0] * dr, self.pixel_mm[1] * dc),
            shape=(len(range(r0, r1, dr)), len(range(c0, c1, dc))),
            principal_point_px=((self.principal_point_px[0] - c0) / dc, (self.principal_point_px[1] - r0) / dr),
        )

    def mirrored(self) -> "Camera":
        """The camera of the image with its columns in reverse order."""
        column, row = self.principal_point_px
        return replace(self, principal_point_px=(self.shape[1] - 1 - column, row))

    def turned(self, quarters: int) -> "Camera":
        """The camera of the image turned counter-clockwise by so many quarter turns, as `torch.rot90` turns it."""
        camera = self
        for _ in range(quarters % 4):
            (column, row), (rows, columns) = camera.principal_point_px, camera.shape
            camera = replace(
                camera,
                pixel_mm=(camera.pixel_mm[1], camera.pixel_mm[0]),
                shape=(columns, rows),
                principal_point_px=(row, columns - 1 - column),
            )
        return camera

    def matrix(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """K (3, 3): pixel (column, row, 1) ∝ K @ point_camera."""
        fx, fy = self.sdd_mm / self.pixel_mm[1], self.sdd_mm / self.pixel_mm[0]
        cx, cy = self.principal_point_px
        return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=dtype)

    def pixel_positions(self, dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Tensor:
        """Pixel centres (rows, columns, 3) in the camera frame, mm."""
        rows, columns = (torch.arange(n, dtype=dtype, device=device) for n in self.shape)
        y = (rows - self.principal_point_px[1]) * self.pixel_mm[0]
        x = (columns - self.principal_point_px[0]) * self.pixel_mm[1]
        grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([grid_x, grid_y, torch.full_like(grid_x, self.sdd_mm)], -1)


def _is_whole(number: Any) -> bool:
    """Whether a number counts something: an int, or NumPy's."""
    try:
        index(number)
    except TypeError:
        return False
    return not isinstance(number, bool)


def _check_size(name: str, values: Sequence[float], smallest: float) -> None:
    """Raise `InputError` for numbers whose size is not between `smallest` and what is plausible; nan is neither."""
    for value in values:
        if not smallest <= abs(value) <= _LARGEST[name]:
            raise InputError(f"camera: {name} must be finite, {smallest:g} to {_LARGEST[name]:g} in size, got {value}.")


def centred_camera(sdd_mm: float, pixel_mm: tuple[float, float], shape: tuple[int, int]) -> Camera:
    """A camera whose central ray meets the middle of the detector, ((W − 1) / 2, (H − 1) / 2)."""
    return Camera(sdd_mm, pixel_mm, shape, ((shape[1] - 1) / 2, (shape[0] - 1) / 2))


def project_points(camera: Camera, points_camera: Tensor) -> Tensor:
    """Pixel positions (column, row) of points in the camera frame.

    `points_camera` is (..., N, 3) in mm. Returns (..., N, 2) in pixels, centre of the first pixel at (0, 0); points
    at or behind the source give nan.
    """
    z = points_camera[..., 2:]
    in_front = z > 0
    xy = points_camera[..., :2] / torch.where(in_front, z, torch.ones_like(z))
    scale = xy.new_tensor([camera.sdd_mm / camera.pixel_mm[1], camera.sdd_mm / camera.pixel_mm[0]])
    pixels = xy * scale + xy.new_tensor(camera.principal_point_px)
    return torch.where(in_front, pixels, torch.full_like(pixels, torch.nan))
