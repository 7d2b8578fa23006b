"""Poses and cameras of neighbouring programs, into this one's and back; docs/frames.md draws each frame.

Here, `camera_from_lps` (4, 4) takes LPS mm of a CT into the camera frame. The others tell a pose by the picture as it
is stored, so that each conversion needs its `Display`: a picture that is a mirror image of what the source sees has a
reflection in it, which no rigid pose holds. All matrices are float64, mm.

- nanodrr 0.1.7 (`camera/extrinsics.py`, `camera/intrinsics.py`): `rt_inv` takes the stored picture's frame (x along
  columns, y along rows, z to the detector) to the RAS mm of the file; its pixel centres lie at + 0.5.
- DiffDRR 0.6.1 (`detector.py`, `data.py`): a pose, after the reorientation that the subject brings, takes a frame with
  x against columns (along them without `reverse_x_axis`), y against rows and z to the detector to RAS mm whose origin
  is the middle of the volume, or that of the file if it was read with `center_volume=False`.
- xvr (`register/pose.py`, `register/logging.py`): the pose of DiffDRR as Euler angles ZXY in radians, and a translation
  that is turned by them; its files hold the matrix. Its pictures are without `reverse_x_axis` unless it is told
  otherwise, those of its versions before 2026 were with it: its files say which.
- xReg (`xregPerspectiveXform.h`): a pose takes the C-arm's world to the CT's LPS, extrinsics the world to the camera,
  whose z leads from detector to source, or the other way.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera, check_rigid, invert_rigid

_RAS_FROM_LPS = torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
_NEGATIVE_Z = "origin-at-focal-pt-det-neg-z"  # xReg's names for where the detector lies
_POSITIVE_Z = "origin-at-focal-pt-det-pos-z"
_FLAT = 0.5  # determinant of a rotation that is none; `check_rigid` is told the exact one


def _matrix(*rows: tuple[int, int, int]) -> Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor(rows, dtype=torch.float64)
    return matrix


_REORIENT = {
    "AP": _matrix((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "PA": _matrix((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    None: torch.eye(4, dtype=torch.float64),
}


def _pose(camera_from_lps: Tensor, whose: str, display: Display) -> Tensor:
    """The pose, if it is rigid; `InputError` that says whether the picture is mirrored against its display."""
    turn = camera_from_lps[:3, :3]
    if torch.linalg.det(turn) < 0:
        raise InputError(
            f"{whose}: this pose is of a picture that is a mirror image of what {display} says. Turn its `mirrored`, "
            "or correct its `source`."
        )
    return check_rigid(camera_from_lps, whose)


def to_nanodrr(camera_from_lps: Tensor, display: Display) -> Tensor:
    """`rt_inv` (4, 4) of nanodrr for pictures that are stored as `display` says."""
    return _RAS_FROM_LPS @ invert_rigid(camera_from_lps.double()) @ display.camera_from_stored


def from_nanodrr(rt_inv: Tensor, display: Display) -> Tensor:
    """`camera_from_lps` (4, 4) of an `rt_inv` (4, 4) of nanodrr. Raises `InputError` if it is mirrored or not rigid."""
    return _pose(display.camera_from_stored @ torch.linalg.inv(rt_inv.double()) @ _RAS_FROM_LPS, "nanodrr", display)


def to_nanodrr_intrinsics(stored: Camera) -> Tensor:
    """`k_inv` (3, 3) of nanodrr, of the camera of the stored pictures."""
    matrix = stored.matrix()
    matrix[:2, 2] += 0.5
    return torch.linalg.inv(matrix)


def from_nanodrr_intrinsics(k_inv: Tensor, sdd_mm: float, shape: tuple[int, int]) -> Camera:
    """The camera of the stored pictures, of a `k_inv` (3, 3) of nanodrr."""
    matrix = torch.linalg.inv(k_inv.double())
    column, row = (matrix[:2, 2] - 0.5).tolist()
    return Camera(sdd_mm, (sdd_mm / matrix[1, 1].item(), sdd_mm / matrix[0, 0].item()), shape, (column, row))


def _to_origin(middle_lps: Tensor) -> Tensor:
    """From RAS mm to those whose origin is the middle of the volume."""
    shift = torch.eye(4, dtype=torch.float64)
    shift[:3, 3] = -_RAS_FROM_LPS[:3, :3] @ middle_lps.double()
    return shift


def _stored_from_diffdrr(reverse_x_axis: bool) -> Tensor:
    """DiffDRR's axes in the stored picture's."""
    return torch.diag(torch.tensor([-1.0 if reverse_x_axis else 1.0, -1, 1, 1], dtype=torch.float64))


def to_diffdrr(
    camera_from_lps: Tensor,
    display: Display,
    middle_lps: Tensor,
    orientation: str | None = "AP",
    reverse_x_axis: bool = True,
) -> Tensor:
    """DiffDRR's pose (4, 4), as `RigidTransform` takes it.

    `middle_lps` (3,) is the middle of the CT's grid, or 0 if DiffDRR reads it with `center_volume=False`. `orientation`
    is what `diffdrr.data.read` is given, `reverse_x_axis` what `diffdrr.drr.DRR` is given, with DiffDRR's defaults.
    "PA" shows mirror images of what the source sees, and so does `reverse_x_axis=False`; together they do not. Raises
    `InputError` where these do not fit `display`.
    """
    ras_from_stored = _to_origin(middle_lps) @ to_nanodrr(camera_from_lps, display)
    pose = ras_from_stored @ _stored_from_diffdrr(reverse_x_axis) @ torch.linalg.inv(_REORIENT[orientation])
    if torch.linalg.det(pose[:3, :3]) < 0:
        raise InputError(
            f"DiffDRR: its orientation {orientation} with reverse_x_axis={reverse_x_axis} shows no picture that is "
            f"stored as {display} says. Change one of the two, or turn the picture's columns round."
        )
    return pose


def from_diffdrr(
    pose: Tensor,
    display: Display,
    middle_lps: Tensor,
    orientation: str | None = "AP",
    reverse_x_axis: bool = True,
) -> Tensor:
    """`camera_from_lps` (4, 4), float64, mm: the inverse of `to_diffdrr`.

    Raises `InputError` if the pose is mirrored or not rigid.
    """
    diffdrr_from_stored = _REORIENT[orientation] @ _stored_from_diffdrr(reverse_x_axis)
    ras_from_stored = torch.linalg.inv(_to_origin(middle_lps)) @ pose.double() @ diffdrr_from_stored
    inverse = display.camera_from_stored @ torch.linalg.inv(ras_from_stored) @ _RAS_FROM_LPS
    return _pose(inverse, "DiffDRR", display)


def diffdrr_offsets(stored: Camera, reverse_x_axis: bool = True) -> tuple[float, float]:
    """`x0` and `y0`, mm, that `diffdrr.drr.DRR` is to be given for the camera of the stored pictures."""
    (column, row), (rows, columns) = stored.principal_point_px, stored.shape
    x, y = (column - (columns - 1) / 2) * stored.pixel_mm[1], (row - (rows - 1) / 2) * stored.pixel_mm[0]
    return x if reverse_x_axis else -x, y


def to_xvr(
    camera_from_lps: Tensor,
    display: Display,
    middle_lps: Tensor,
    *,
    reverse_x_axis: bool,
    orientation: str | None = "AP",
) -> tuple[Tensor, Tensor]:
    """Rotation (3,), Euler angles ZXY in radians, and translation (3,), mm, of xvr.

    What `xvr register fixed` takes in degrees; arguments as for `to_diffdrr`, and what xvr itself is told.
    """
    pose = to_diffdrr(camera_from_lps, display, middle_lps, orientation, reverse_x_axis)
    turn = pose[:3, :3]
    angles = Rotation.from_matrix(turn.numpy()).as_euler("ZXY")
    return torch.from_numpy(np.ascontiguousarray(angles)), turn.mT @ pose[:3, 3]


def from_xvr(
    rotation: Tensor,
    translation: Tensor,
    display: Display,
    middle_lps: Tensor,
    *,
    reverse_x_axis: bool,
    orientation: str | None = "AP",
) -> Tensor:
    """`camera_from_lps` (4, 4), float64, mm: the inverse of `to_xvr`."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_euler("ZXY", rotation.double().numpy()).as_matrix())
    pose[:3, 3] = pose[:3, :3] @ translation.double()
    return from_diffdrr(pose, display, middle_lps, orientation, reverse_x_axis)


@dataclass(frozen=True, eq=False)
class XregCamera:
    """A camera of xReg: what its files hold."""

    intrinsic: Tensor  # (3, 3)
    extrinsic: Tensor  # (4, 4) camera from world
    shape: tuple[int, int]
    pixel_mm: tuple[float, float]  # row, column spacing
    frame: str = _NEGATIVE_Z

    @property
    def stored_from_camera(self) -> Tensor:
        """(4, 4) from xReg's camera frame to that of the stored picture."""
        if self.frame not in (_NEGATIVE_Z, _POSITIVE_Z):
            raise InputError(f"xReg camera: the frame {self.frame!r} is not known, its origin must be at the source.")
        z = -1.0 if self.frame == _NEGATIVE_Z else 1.0
        along_columns, along_rows = (z * float(torch.sign(self.intrinsic[n, n])) for n in (0, 1))
        return torch.diag(torch.tensor([along_columns, along_rows, z, 1.0], dtype=torch.float64))

    @property
    def camera(self) -> Camera:
        """The camera of the stored picture. Raises `InputError` where the two focal lengths tell two distances."""
        sdd = [abs(self.intrinsic[n, n].item()) * mm for n, mm in ((0, self.pixel_mm[1]), (1, self.pixel_mm[0]))]
        if abs(sdd[0] - sdd[1]) > 1e-3 * sdd[0] or abs(self.intrinsic[0, 1].item()) > 1e-6:
            raise InputError(
                f"xReg camera: its focal lengths tell distances of {sdd[0]:g} and {sdd[1]:g} mm, or it is sheared."
            )
        column, row = self.intrinsic[0, 2].item(), self.intrinsic[1, 2].item()
        return Camera(sum(sdd) / 2, self.pixel_mm, self.shape, (column, row))

    def camera_from_lps(self, lps_from_world: Tensor, display: Display) -> Tensor:
        """Of a pose "cam-to-vol" (4, 4), from the C-arm's world to the CT. Raises `InputError` if it is mirrored."""
        if lps_from_world[:3, :3].det().abs() < _FLAT:
            raise InputError("xReg: a pose of the CT flattens it, so it is not rigid.")
        stored = self.stored_from_camera @ self.extrinsic @ torch.linalg.inv(lps_from_world.double())
        return _pose(display.camera_from_stored @ stored, "xReg", display)

    def lps_from_world(self, camera_from_lps: Tensor, display: Display) -> Tensor:
        """The pose "cam-to-vol" (4, 4), float64, mm: the inverse of `camera_from_lps`."""
        stored_from_lps = torch.linalg.inv(display.camera_from_stored) @ camera_from_lps.double()
        return torch.linalg.inv(stored_from_lps) @ self.stored_from_camera @ self.extrinsic
