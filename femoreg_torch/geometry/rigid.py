"""Rigid transforms as 4×4 matrices, batched, differentiable everywhere that matters (identity and near π included).

A transform is named after what it does: `camera_from_object` takes points of the object to the camera frame. A twist is
(rotation vector in radians, translation in mm), in this order, as a tensor (..., 6).
"""

import math

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.errors import InputError, in_mm

_SMALL = 1e-2  # rad; below it the series beat the closed forms even in float32

_EXACT = 1e-9  # of a rotation times its transposed: nothing was cut off
_ROUNDED = 2e-4  # the same of one with four decimals: 2 · √3 · 0.00005, and some

FARTHEST_MM = 1e5  # of anything in an operating theatre


def skew(vector: Tensor) -> Tensor:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(a) @ b == cross(a, b)`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _trigonometric_factors(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin θ / θ, (1 − cos θ) / θ² and (θ − sin θ) / θ³ from θ², smooth at zero."""
    small = angle_squared < _SMALL**2
    safe = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    angle = safe.sqrt()
    t = angle_squared
    a = torch.where(small, 1 - t / 6 * (1 - t / 20), angle.sin() / angle)
    b = torch.where(small, 0.5 - t / 24 * (1 - t / 30), (1 - angle.cos()) / safe)
    c = torch.where(small, 1 / 6 - t / 120 * (1 - t / 42), (angle - angle.sin()) / (safe * angle))
    return a, b, c


def exp_so3(rotation_vector: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians, by Rodrigues' formula."""
    a, b, _ = _trigonometric_factors((rotation_vector**2).sum(-1))
    k = skew(rotation_vector)
    eye = torch.eye(3, dtype=k.dtype, device=k.device)
    return eye + a[..., None, None] * k + b[..., None, None] * (k @ k)


def _quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternions (..., 4) as (w, x, y, z) with w ≥ 0, from the best conditioned of the four classical formulas.

    Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1 (1978) 223.
    """
    m = rotation
    diagonal = m.diagonal(dim1=-2, dim2=-1)
    xx, yy, zz = diagonal.unbind(-1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, a, b, c], -1),
            torch.stack([a, 1 + xx - yy - zz, d, e], -1),
            torch.stack([b, d, 1 - xx + yy - zz, f], -1),
            torch.stack([c, e, f, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(rows, best[..., None, None], -2).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def log_so3(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3) in radians, of length at most π, of rotation matrices (..., 3, 3)."""
    q = _quaternion(rotation)
    w, v = q[..., 0], q[..., 1:]
    s2 = (v**2).sum(-1)
    small = s2 < _SMALL**2
    safe = torch.where(small, torch.ones_like(s2), s2)
    s = safe.sqrt()
    factor = torch.where(small, 2 + s2 / 3 + 3 * s2**2 / 20, 2 * torch.atan2(s, w) / s)  # 2 asin(s) / s
    return factor[..., None] * v


def rigid(rotation: Tensor | None = None, translation: Tensor | None = None) -> Tensor:
    """4×4 transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3) in mm; either may be left out."""
    if rotation is None:
        if translation is None:
            return torch.eye(4, dtype=torch.float64)
        rotation = torch.eye(3, dtype=translation.dtype, device=translation.device).expand(
            *translation.shape[:-1], 3, 3
        )
    if translation is None:
        translation = rotation.new_zeros(rotation.shape[:-1])
    # torch's own function imports its tracer of shapes, for a third of a second
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    top = torch.cat([rotation.expand(*shape, 3, 3), translation.expand(*shape, 3)[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*shape, 1, 4)
    return torch.cat([top, bottom], -2)


def exp_se3(twist: Tensor) -> Tensor:
    """4×4 transforms of twists (..., 6) = (rotation vector in radians, translation in mm).

    The translation passes through the left Jacobian of SO(3): Barfoot, State Estimation for Robotics, eq. 7.82 to 7.86.
    """
    rotation_vector, translation = twist[..., :3], twist[..., 3:]
    _, b, c = _trigonometric_factors((rotation_vector**2).sum(-1))
    k = skew(rotation_vector)
    eye = torch.eye(3, dtype=k.dtype, device=k.device)
    jacobian = eye + b[..., None, None] * k + c[..., None, None] * (k @ k)
    return rigid(exp_so3(rotation_vector), (jacobian @ translation[..., None]).squeeze(-1))


def log_se3(transform: Tensor) -> Tensor:
    """Twists (..., 6) of 4×4 transforms (..., 4, 4); the inverse of `exp_se3` for rotations below π."""
    rotation_vector = log_so3(transform[..., :3, :3])
    _, b, c = _trigonometric_factors((rotation_vector**2).sum(-1))
    k = skew(rotation_vector)
    eye = torch.eye(3, dtype=k.dtype, device=k.device)
    jacobian = eye + b[..., None, None] * k + c[..., None, None] * (k @ k)
    translation = torch.linalg.solve(jacobian, transform[..., :3, 3:]).squeeze(-1)
    return torch.cat([rotation_vector, translation], -1)


def invert_rigid(b_from_a: Tensor) -> Tensor:
    """`a_from_b` (..., 4, 4) of a rigid `b_from_a`, without a general matrix inverse."""
    transposed = b_from_a[..., :3, :3].mT
    return rigid(transposed, -(transposed @ b_from_a[..., :3, 3:]).squeeze(-1))


def transform_points(b_from_a: Tensor, points_a: Tensor) -> Tensor:
    """Points (..., N, 3) in frame b of points (..., N, 3) in frame a; `b_from_a` is (..., 4, 4)."""
    return points_a @ b_from_a[..., :3, :3].mT + b_from_a[..., None, :3, 3]


def about_point(transform: Tensor, centre: Tensor) -> Tensor:
    """The transform (..., 4, 4) applied with `centre` (..., 3) as origin: translate(c) · transform · translate(−c)."""
    rotation, shift = transform[..., :3, :3], transform[..., :3, 3]
    moved = (rotation @ centre[..., None]).squeeze(-1)
    return rigid(rotation, shift + centre - moved)


def twist_rates(changes: Tensor, pose: Tensor, centre: Tensor) -> Tensor:
    """Twists (..., 6, n) about `centre` (..., 3) that belong to changes (..., n, 4, 4) of poses (..., 4, 4).

    The centre is in mm in the camera frame.
    """
    velocity = changes @ invert_rigid(pose)[..., None, :, :]  # (..., n, 4, 4): of points in the camera frame
    spin = velocity[..., :3, :3]
    rotation = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], -2)
    shift = (spin @ centre[..., None, :, None])[..., 0] + velocity[..., :3, 3]
    return torch.cat([rotation, shift.mT], -2)


def rotation_angle(rotation: Tensor) -> Tensor:
    """Axis angle (...) in radians, in [0, π], of rotation matrices (..., 3, 3)."""
    q = _quaternion(rotation)
    return 2 * torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0])


def pose_difference(first: Tensor, second: Tensor, point: Tensor) -> tuple[float, float]:
    """Degrees between two poses (4, 4) of an object, and mm between the places they give to its `point` (3,)."""
    turned = torch.rad2deg(rotation_angle(first[:3, :3].mT @ second[:3, :3]))
    shift = transform_points(second, point[None]) - transform_points(first, point[None])
    return float(turned), float(shift.norm())


def check_rigid(transform: Tensor, where: str) -> Tensor:
    """A 4×4 rigid transform without reflection, as a file has it: the nearest one, where digits were cut off.

    Four decimals are enough: they turn by 0.006°, which is 0.1 mm at the end of a metre. Raises an `InputError` that
    names `where` for what is no such transform.
    """
    if transform.shape != (4, 4):
        raise InputError(f"{where}: a 4×4 matrix was expected, this one is {tuple(transform.shape)}.")
    if not torch.isfinite(transform).all():
        raise InputError(f"{where}: the matrix holds values that are not finite. Write it anew.")
    if transform[:3, 3].abs().max() > FARTHEST_MM:
        raise InputError(
            f"{where}: moves by {in_mm(float(transform[:3, 3].abs().max()))}, farther than any room. Is it in mm?"
        )
    rotation = transform[:3, :3]
    bottom = transform.new_tensor([0.0, 0.0, 0.0, 1.0])
    gap = (rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max().item()
    if (transform[3] - bottom).abs().max() > _ROUNDED and torch.equal(transform[:, 3], bottom):
        raise InputError(
            f"{where}: not a rigid transform, as its translation stands in the last row. Transpose it: x y z 1 is the "
            "last column."
        )
    if (transform[3] - bottom).abs().max() > _ROUNDED or gap > _ROUNDED:
        raise InputError(
            f"{where}: not a rigid transform (its rotation is off orthonormal by {gap:.2g}, its last row is "
            f"{[round(v, 4) for v in transform[3].tolist()]}). Remove scaling and shear, and write four decimals at "
            "least."
        )
    if torch.linalg.det(rotation) < 0:
        raise InputError(f"{where}: a mirrored (left-handed) transform, determinant −1. Check for RAS/LPS mix-ups.")
    if gap < _EXACT and torch.equal(transform[3], bottom):
        return transform
    u, _, vh = torch.linalg.svd(rotation)
    return rigid(u @ vh, transform[:3, 3])


def euler_xyz_deg(rotation: Tensor) -> Tensor:
    """Angles (..., 3) in degrees about the fixed axes x, y, z: R = Rz · Ry · Rx (the paper's xyz convention)."""
    y = torch.atan2(-rotation[..., 2, 0], torch.hypot(rotation[..., 2, 1], rotation[..., 2, 2]))
    x = torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2])
    z = torch.atan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return torch.stack([x, y, z], -1) * (180 / math.pi)
