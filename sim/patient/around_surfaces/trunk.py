"""The body around the bones: size and turn of the trunk, the thighs, and the box that holds them."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from femoreg_torch.segment.rules import unit
from sim.patient.skeleton import SIDES

Points = NDArray[np.float64]
Surfaces = dict[str, trimesh.Trimesh]


@dataclass(frozen=True, eq=False)
class Trunk:
    """Size and turn of the trunk, in mm with the origin between the femoral heads."""

    turn: Points  # (2, 2): x, y of the patient space to left, back of the pelvis
    centre: float  # along back
    wide: float  # half width
    deep: float  # half depth


def measure_trunk(bones: Surfaces, pelvic_frame: Points) -> Trunk:
    """Fit the trunk around the bones; it turns with the pelvis about the long axis."""
    c, s = unit(pelvic_frame[0, :2])
    turn = np.array([[c, s], [-s, c]])
    pelvis = np.vstack([bones[name].vertices[:, :2] for name in ("hip_left", "hip_right", "sacrum")]) @ turn.T
    femora = np.vstack([bones[f"femur_{side}"].vertices[:, :2] for side in SIDES]) @ turn.T
    return Trunk(
        turn,
        (pelvis[:, 1].min() + pelvis[:, 1].max()) / 2 - 2,
        max(176.0, np.abs(femora[:, 0]).max() + 28),
        max(112.0, np.ptp(pelvis[:, 1]) / 2 + 36),
    )


def thigh_outline(femur: trimesh.Trimesh, z: NDArray[np.floating]) -> tuple[Points, Points, Points, Points]:
    """Inner and outer edge, middle and half of the depth of one thigh at the heights `z` (N,): (N,) each, mm.

    Edges count along x from the midline.
    """
    vertices = femur.vertices
    levels = np.arange(-240, -75, 10)
    at = np.array([vertices[np.abs(vertices[:, 2] - level) < 6].mean(0) for level in levels])
    x, y = (np.polyval(np.polyfit(levels, at[:, k], 1), z) for k in (0, 1))
    outer = np.abs(x) + np.interp(z, [-300, -180, -60, 0, 50], [34, 44, 48, 42, 0])
    inner = np.maximum(outer - np.interp(z, [-300, -180, -60], [132, 164, 176]), 2)
    taper = np.interp(z, [-60, 0, 60], [1, 0.9, 0.3])  # the thigh fades into the trunk
    inner = outer - taper * (outer - inner)
    return inner, outer, y + 4, taper * np.interp(z, [-300, -180, -60], [72, 88, 97])


def body_box(bones: Surfaces, trunk: Trunk, below_mm: int) -> tuple[Points, Points]:
    """Corners (3,) of the volume in whole mm, with air all around the body except above and below."""
    c, s = np.abs(trunk.turn[0])
    reach = 1.04 * np.array([np.hypot(trunk.wide * c, trunk.deep * s), np.hypot(trunk.wide * s, trunk.deep * c)])
    middle = trunk.centre * trunk.turn[1]
    low, high = middle - reach, middle + reach
    for side, sign in SIDES.items():
        _, outer, y, half = thigh_outline(bones[f"femur_{side}"], np.arange(-below_mm, 1.0))
        low = np.minimum(low, [(sign * outer).min(), (y - half).min()])
        high = np.maximum(high, [(sign * outer).max(), (y + half).max()])
    top = max(mesh.bounds[1, 2] for mesh in bones.values()) + 12
    return np.floor([*(low - 8), -below_mm]), np.ceil([*(high + 8), top])
