"""What presses on a femur and what holds it, as springs at nodes: pads of PMMA and the cut of the shaft.

Where pads meet the bone, how large they are, where caps end and where the cut is, follow from the bone's voxels and not
from elements: taken from elements, the pad's area changed by a tenth, and the load by 7 %, with a mesh moved by half an
element. Springs work along any direction, so that the voxels stay as the CT has them. Fall to the side, as in the open
tools Ogo and parosol-py: the pad of the head is moved along the force, that of the trochanter gives way square to it,
and the shaft's cut is held square to it. Stance: the cut is held in all directions, and there is no second pad.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.errors import InputError
from femoreg_torch.planning.femur import Femur, Frame
from femoreg_torch.planning.mesh import Mesh
from femoreg_torch.planning.model import Model
from femoreg_torch.planning.settings import LoadSettings

Array = NDArray[np.float64]

_HEAD_RADII = 1.25  # from the head's centre: what may bear the pad of the head
_CAP_SHARE = 0.5  # of an element: so much within a cap, and it does not yield
_CUT_MM = 4.5  # of the shaft, from its lowest voxel, held at its cut
_HELD_FACTOR = 100.0  # stiffness of what holds the cut, over that of a pad: as good as rigid


@dataclass(frozen=True, eq=False)
class Loading:
    """Springs at nodes (N, 3, 3), N/mm, and what moving the pad of the head does. Along the CT's index axes."""

    direction: Array  # (3,) unit vector of the force on the head
    springs: Array  # (N, 3, 3), all of them
    head: Array  # (N,) stiffness of the head's pad along the force, N/mm
    trochanter: Array  # (N,) that of the other pad
    cap_modulus: Array  # (E, 8) MPa that bone in caps has at least, by how far it fills a Gauss point's eighth; else 0
    span_mm: float  # length of the bone along the force between the pads

    @property
    def caps(self) -> NDArray[np.bool_]:
        """Gauss points (E, 8) that do not yield."""
        return np.asarray(self.cap_modulus > 0)

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


def make_loading(model: Model, femur: Femur, settings: LoadSettings) -> Loading:
    """Pads and held nodes of the mesh of a femur. Raises `InputError` if a pad meets no bone."""
    mesh, frame = model.mesh, femur.frame
    force = force_direction(frame, settings)
    direction = mesh.axes.T @ force
    places = np.argwhere(model.voxels)
    voxels = femur.points(places)
    lowest = float(((voxels - frame.head) @ frame.proximal).min())
    pad = settings.pad_modulus_mpa / settings.pad_thickness_mm  # N/mm per mm² of a foundation
    faces = _faces(model, femur, -direction)
    faces = faces.where(~_beyond_head(faces.points, frame))
    head, top = _pad(mesh, faces, -force, pad, settings.pad_depth_mm, "head")
    cut = (mesh.points - frame.head) @ frame.proximal < lowest + _CUT_MM
    trochanter, bottom = np.zeros(len(mesh.nodes)), np.inf
    along_force = np.outer(direction, direction)
    held = np.eye(3)
    if settings.kind == "fall":
        faces = _faces(model, femur, direction)
        faces = faces.where(_may_meet_ground(faces.points, frame))
        trochanter, bottom = _pad(mesh, faces, force, pad, settings.pad_depth_mm, "greater trochanter")
        held = held if settings.distal == "fixed" else held - along_force
    grip = _HELD_FACTOR * pad * mesh.size_mm**2
    springs = (head + trochanter)[:, None, None] * along_force + np.where(cut, grip, 0.0)[:, None, None] * held
    along = voxels @ force
    in_caps = ~_beyond_head(voxels, frame) & (-along > top - settings.cap_mm)
    if settings.kind == "fall":
        in_caps |= _may_meet_ground(voxels, frame) & (along > bottom - settings.cap_mm)
    in_caps |= (voxels - frame.head) @ frame.proximal < lowest + settings.cap_mm
    hard = np.zeros(model.voxels.shape)
    hard[tuple(places[in_caps].T)] = 1
    caps = (model.fill > 0) & (mesh.of(model.grid.octants(hard)) >= (_CAP_SHARE - 1e-9) * model.fill)
    span = bottom + top if settings.kind == "fall" else float(np.ptp(along))
    cap_modulus = np.where(caps, settings.pad_modulus_mpa * model.fill, 0.0)
    return Loading(direction, springs, head, trochanter, cap_modulus, span)


@dataclass(frozen=True, eq=False)
class _Faces:
    """Faces of voxels at the surface that look against a pad: middles (M, 3), LPS mm, and areas square to the force."""

    points: Array
    area: Array  # (M,) mm²

    def where(self, taken: NDArray[np.bool_]) -> "_Faces":
        return _Faces(self.points[taken], self.area[taken])


def _faces(model: Model, femur: Femur, direction: Array) -> _Faces:
    """Those that look along a unit vector (3,), along the index axes; areas add up to the projection along it."""
    padded = np.pad(model.voxels, 1)
    points, areas = [], []
    for axis in range(3):
        step = int(np.sign(direction[axis])) or 1
        free = padded & ~np.roll(padded, -step, axis)
        middles = np.argwhere(free[1:-1, 1:-1, 1:-1]).astype(float)
        middles[:, axis] += step / 2
        points.append(femur.points(middles))
        area = abs(float(direction[axis])) * float(np.prod(np.delete(femur.spacing, axis)))
        areas.append(np.full(len(middles), area))
    return _Faces(np.concatenate(points), np.concatenate(areas))


def _beyond_head(points: Array, frame: Frame) -> NDArray[np.bool_]:
    """Which points (N, 3) the pad of the head does not reach."""
    return np.asarray(np.linalg.norm(points - frame.head, axis=1) >= _HEAD_RADII * frame.head_radius)


def _may_meet_ground(points: Array, frame: Frame) -> NDArray[np.bool_]:
    """Which points (N, 3) the pad of the trochanter may reach: not those of the head, and not those of the shaft."""
    return np.asarray(_beyond_head(points, frame) & ((points - frame.head) @ frame.proximal > -_shaft_from(frame)))


def _shaft_from(frame: Frame) -> float:
    """How far below the head's centre the region of the trochanter's pad ends, mm: two diameters of the head."""
    return 3 * frame.head_radius


def _pad(mesh: Mesh, faces: _Faces, normal: Array, stiffness: float, depth_mm: float, name: str) -> tuple[Array, float]:
    """Springs (N,) of a pad on the faces within `depth_mm` of the highest along its normal (3,), LPS; that height."""
    if not (faces.area > 0).any():
        raise InputError(f"load: the pad of the {name} meets no bone. Check the label and the angles of the load.")
    height = faces.points @ normal
    top = float(height[faces.area > 0].max())
    return mesh.shared(faces.points, np.where(height > top - depth_mm, stiffness * faces.area, 0.0)), top
