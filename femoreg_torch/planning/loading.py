"""What presses on a femur and what holds it, as springs at nodes: pads of PMMA and the cut of the shaft.

Springs work along any direction, so that the voxels stay as the CT has them. Fall to the side, as in the open tools Ogo
and parosol-py: the pad of the head is moved along the force, that of the trochanter gives way square to it, and the
shaft's cut is held square to it. Stance: the cut is held in all directions, and there is no second pad.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.errors import InputError
from femoreg_torch.planning.femur import Frame
from femoreg_torch.planning.mesh import Mesh
from femoreg_torch.planning.settings import LoadSettings

Array = NDArray[np.float64]

_HEAD_RADII = 1.25  # from the head's centre: what may bear the pad of the head
_CUT_LAYERS = 1.5  # of elements, held at the shaft's cut
_HELD_FACTOR = 100.0  # stiffness of what holds the cut, over that of a pad: as good as rigid


@dataclass(frozen=True, eq=False)
class Loading:
    """Springs at nodes (N, 3, 3), N/mm, and what moving the pad of the head does. Along the CT's index axes."""

    direction: Array  # (3,) unit vector of the force on the head
    springs: Array  # (N, 3, 3), all of them
    head: Array  # (N,) stiffness of the head's pad along the force, N/mm
    trochanter: Array  # (N,) that of the other pad
    caps: NDArray[np.bool_]  # (E,) elements that do not yield
    span_mm: float  # length of the bone along the force between the pads

    def push(self, displacement_mm: float) -> Array:
        """Forces (N, 3) of the head's pad, its far side moved by that much, on a bone that does not move."""
        return np.asarray(self.head[:, None] * self.direction * displacement_mm)

    def load(self, displacement_mm: float, u: Array) -> float:
        """Force in N on the head at displacements (N, 3)."""
        return float(self.head @ (displacement_mm - u @ self.direction))

    def reactions(self, u: Array) -> tuple[Array, Array]:
        """Forces (3,), N, on the bone: from the trochanter's pad, and from all springs but the head's pad."""
        trochanter = -(self.trochanter @ (u @ self.direction)) * self.direction
        rest = self.springs - self.head[:, None, None] * np.outer(self.direction, self.direction)
        return np.asarray(trochanter), np.asarray(-np.einsum("nij,nj->i", rest, u))


def force_direction(frame: Frame, settings: LoadSettings) -> Array:
    """Unit vector (3,), LPS, of the force on the head.

    Fall: to the side of the trochanter, in the plane of neck and shaft. A neck turned inwards brings the head back, so
    the force leans to the back by that angle; an adducted leg has its knee above its hip, so the force leans to the
    proximal end. Stance: along the shaft, leaning to the side.
    """
    if settings.kind == "stance":
        lean = math.radians(settings.stance_deg)
        return np.asarray(-math.cos(lean) * frame.proximal + math.sin(lean) * frame.lateral)
    turn, tilt = math.radians(settings.internal_rotation_deg), math.radians(settings.adduction_deg)
    across = math.cos(turn) * frame.lateral + math.sin(turn) * frame.posterior
    return np.asarray(math.cos(tilt) * across + math.sin(tilt) * frame.proximal)


def make_loading(mesh: Mesh, frame: Frame, settings: LoadSettings) -> Loading:
    """Pads and held nodes of a mesh. Raises `InputError` if a pad meets no bone."""
    direction = mesh.axes.T @ force_direction(frame, settings)
    points = mesh.points
    along = points @ (mesh.axes @ direction)
    pad = settings.pad_modulus_mpa / settings.pad_thickness_mm  # N/mm per mm² of a foundation
    on_head = np.linalg.norm(points - frame.head, axis=1) < _HEAD_RADII * frame.head_radius
    head, top = _pad(mesh, -direction, -along, on_head, pad, settings.pad_depth_mm, "head")
    below = (points - frame.head) @ frame.proximal
    cut = below < below.min() + _CUT_LAYERS * mesh.size_mm
    trochanter, bottom = np.zeros(len(points)), np.inf
    identity, along_force = np.eye(3), np.outer(direction, direction)
    held = identity
    if settings.kind == "fall":
        not_shaft = (below > -_shaft_from(frame)) & ~on_head
        trochanter, bottom = _pad(mesh, direction, along, not_shaft, pad, settings.pad_depth_mm, "greater trochanter")
        held = identity if settings.distal == "fixed" else identity - along_force
    grip = _HELD_FACTOR * pad * mesh.size_mm**2
    springs = (head + trochanter)[:, None, None] * along_force + np.where(cut, grip, 0.0)[:, None, None] * held
    centres = mesh.centres @ (mesh.axes @ direction)
    near_head = np.linalg.norm(mesh.centres - frame.head, axis=1) < _HEAD_RADII * frame.head_radius
    caps = near_head & (-centres > top - settings.cap_mm)
    level = (mesh.centres - frame.head) @ frame.proximal
    if settings.kind == "fall":
        caps |= ~near_head & (centres > bottom - settings.cap_mm) & (level > -_shaft_from(frame))
    caps |= level < level.min() + settings.cap_mm
    span = float(bottom + top) if settings.kind == "fall" else float(along.max() - along.min())
    return Loading(direction, springs, head, trochanter, caps, span)


def _shaft_from(frame: Frame) -> float:
    """How far below the head's centre the region of the trochanter's pad ends, mm: two diameters of the head."""
    return 3 * frame.head_radius


def _pad(
    mesh: Mesh, normal: Array, height: Array, allowed: NDArray[np.bool_], stiffness: float, depth_mm: float, name: str
) -> tuple[Array, float]:
    """Springs (N,) of a pad that meets the surface facing `normal` within `depth_mm` of its highest point; its top."""
    area = np.where(allowed, mesh.surface(normal), 0.0)
    if not (area > 0).any():
        raise InputError(f"load: the pad of the {name} meets no bone. Check the label and the angles of the load.")
    top = float(height[area > 0].max())
    return stiffness * np.where(height > top - depth_mm, area, 0.0), top
