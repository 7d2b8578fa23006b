"""A synthetic drilling and injection device: a guide sleeve with the handle that a robot holds.

CAD frame, mm: z along the guide from its base (z = 0) to its tip (z = guide length), the bore's axis at x = y = 0; the
handle stands off in +x. Nothing about it is symmetric, so that its pose can be told from its shadow.
"""

from dataclasses import dataclass

import manifold3d  # noqa: F401  # engine of trimesh.boolean: where it is missing, this says so at once
import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from femoreg_torch.errors import InputError

GUIDE_LENGTH_MM = (96.0, 106.0)
OUTER_DIAMETER_MM = (8.0, 12.0)
WALL_MM = (1.6, 2.6)
SECTIONS = 64
PARTS = {  # of which solids each part consists
    "sleeve": ("sleeve", "flange"),
    "clamp": ("clamp",),
    "arm": ("arm", "knob", "stud"),
    "grip": ("grip",),
    "fin": ("fin",),
}


def _cylinder(radius: float, start: tuple[float, float, float], end: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=radius, segment=[start, end], sections=SECTIONS)


def _block(
    size: tuple[float, float, float], centre: tuple[float, float, float], turn_deg: float = 0.0
) -> trimesh.Trimesh:
    """Box of `size` mm, turned about z by `turn_deg`, around `centre`."""
    placed = np.eye(4)
    placed[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    placed[:3, 3] = centre
    return trimesh.creation.box(extents=size, transform=placed)


@dataclass(frozen=True, eq=False)
class _Shapes:
    """What a device is built of: solids by name, the holes through them, and its named points."""

    solids: dict[str, trimesh.Trimesh]
    holes: list[trimesh.Trimesh]
    points: dict[str, Tensor]


def _shapes(seed: int) -> _Shapes:
    if seed < 0:
        raise InputError(f"device: seed is {seed}, expected 0 or more.")
    rng = np.random.default_rng(seed)
    length = rng.uniform(*GUIDE_LENGTH_MM)
    outer = rng.uniform(*OUTER_DIAMETER_MM) / 2
    bore = outer - rng.uniform(*WALL_MM)
    collar = rng.uniform(0.18, 0.26) * length
    arm_at = rng.uniform(0.30, 0.42) * length
    arm_reach, arm_turn = rng.uniform(34, 44), rng.uniform(6, 16)
    pin = rng.uniform(2.4, 3.4)

    solids = {
        "sleeve": _cylinder(outer, (0, 0, 0), (0, 0, length)),
        "flange": _cylinder(outer + rng.uniform(3, 5), (0, 0, 3), (0, 0, 3 + 0.3 * collar)),
        "clamp": _block((2.6 * outer, 2.2 * outer + 4, 20), (0.5 * outer, 2.0, arm_at), arm_turn),
        "arm": _block((arm_reach, 9, 13), (outer + arm_reach / 2 - 2, 2.5, arm_at + 1), 0),
        "grip": _block((12, 20, 36), (outer + arm_reach, 5.0, arm_at + 8), arm_turn),
        "fin": _block((3, 14, 12), (-0.2 * outer, -outer - 5, arm_at - 14), -20),
        "knob": _cylinder(5.0, (outer + 0.55 * arm_reach, 4, arm_at), (outer + 0.55 * arm_reach, 22, arm_at + 3)),
        "stud": _cylinder(pin, (outer + arm_reach, -2, arm_at + 18), (outer + arm_reach + 14, -16, arm_at + 24)),
    }
    channel = _cylinder(bore, (0, 0, -5), (0, 0, length + 5))
    hole = _cylinder(pin, (outer + 0.30 * arm_reach, -20, arm_at + 1), (outer + 0.30 * arm_reach, 40, arm_at + 1))
    slot = _block((30, 6, 8), (outer + arm_reach, 5.0, arm_at - 2), arm_turn)
    window = _cylinder(
        0.6 * bore, (0, 0, 0.80 * length), (0, -3 * outer, 0.80 * length)
    )  # shows the drill; marks the tip
    points = {"tip": (0.0, 0.0, length), "base": (0.0, 0.0, 0.0), "center": (0.0, 0.0, length / 2)}
    return _Shapes(
        solids,
        [channel, hole, slot, window],
        {name: torch.tensor(point, dtype=torch.float64) for name, point in points.items()},
    )


def make_device(seed: int) -> tuple[trimesh.Trimesh, dict[str, Tensor]]:
    """Device of one seed: a watertight surface in the CAD frame (mm) and its named points.

    Args:
        seed: not negative; draws the dimensions, within about 110 mm along the guide.

    Returns:
        The surface, and `tip` (centre of the guide's tip), `base` (on the axis, other end) and `center` (middle of
        the guide), each (3,) float64 mm.
    """
    shapes = _shapes(seed)
    device = trimesh.boolean.difference([trimesh.boolean.union(list(shapes.solids.values())), *shapes.holes])
    device.merge_vertices()
    return device, shapes.points


def make_device_parts(seed: int) -> dict[str, trimesh.Trimesh]:
    """The same device taken apart: closed surfaces in the CAD frame (mm) that do not overlap and together fill it.

    Where solids overlap, the part that stands first in `PARTS` owns the overlap: the sleeve is whole, and the arm runs
    into the grip.
    """
    shapes = _shapes(seed)
    parts: dict[str, trimesh.Trimesh] = {}
    taken = list(shapes.holes)
    for name, solids in PARTS.items():
        whole = trimesh.boolean.union([shapes.solids[solid] for solid in solids])
        part = trimesh.boolean.difference([whole, *taken])
        part.merge_vertices()
        parts[name] = part
        taken.append(whole)
    return parts
