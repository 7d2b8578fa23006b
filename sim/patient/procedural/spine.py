"""Sacrum and the two lowest lumbar vertebrae in the frame of the standard pelvis of `sim.patient.procedural.hip`."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.patient.distance_field import Field, ball_union, rod, sheet, tube

Points = NDArray[np.float64]
Rods = list[tuple[Points, Points, float]]

FIELD_STEP = 1.5
JOINT_GAP = 2.2  # mm between sacrum and ilium

# middle of each level: back, up, and radius of the body; then half width, back, up and radius of the lateral mass
_LEVELS = [
    ((52, 99, 13), (55, 57, 93, 11)),
    ((66, 79, 11.5), (54, 61, 77, 11)),
    ((80, 60, 9), (45, 73, 60, 9)),
    ((92, 42, 7), (35, 87, 44, 6.5)),
    ((99, 25, 5.8), (24, 96, 27, 5)),
    ((101, 11, 5), (15, 100, 12, 4)),
    ((97, -2, 4.2), (7, 97, -2, 3.4)),
    ((89, -13, 3.2), (4, 89, -13, 2.8)),
]
_PROMONTORY = np.array([0.0, 44.0, 110.0])  # middle of the upper end plate
_LUMBAR_TILT = (26.0, 12.0)  # degrees that L5 and L4 lean forwards
_BODY_HEIGHT, _DISC = 27.0, 10.5
_BODY_HALF_WIDTH, _BODY_HALF_DEPTH = 24.0, 16.5


def _mirrored(balls: Points) -> Points:
    return np.r_[balls, balls * [-1, 1, 1, 1]]


def sacrum_balls() -> Points:
    """Skeleton of the sacrum and coccyx, (N, 4)."""
    rows = []
    for (back, up, radius), (half_width, side_back, side_up, side_radius) in _LEVELS:
        middle = np.array([0.0, back, up, radius])
        side = np.array([half_width, side_back, side_up, side_radius])
        rows.append([middle + t * (side - middle) * [1, t**0.5 if t else 0, t, 1] for t in (0.0, 0.33, 0.67, 1.0)])
    upper_body = sheet(
        [[[0, 43, 105, 9], [10, 43, 105, 9], [17, 45, 104, 6]], [[0, 62, 90, 10], [10, 61, 90, 10], [18, 60, 90, 7]]]
    )
    plate = sheet(
        [[[0, 36, 106, 3], [12, 37, 106, 3], [20, 42, 106, 3]], [[0, 54, 111, 3], [12, 53, 111, 3], [20, 50, 110, 3]]]
    )
    joint = tube([[22, 68, 98, 6], [23, 66, 107, 5.5], [22, 64, 115, 4]])
    crest = tube([[0, 84, 93, 4], [0, 95, 80, 5], [0, 103, 66, 5], [0, 107, 50, 4.5], [0, 108, 35, 4], [0, 106, 22, 3]])
    lamina = sheet(
        [[[0, 81, 92, 4], [22, 73, 94, 5]], [[0, 95, 68, 4], [20, 88, 72, 5]], [[0, 104, 42, 3.5], [14, 99, 44, 4]]]
    )
    return np.concatenate([_mirrored(np.concatenate([sheet(rows), upper_body, plate, joint, lamina])), crest])


def sacral_holes() -> Rods:
    """Four pairs of sacral foramina and the canal: ends in the pelvic frame and radius."""
    holes: Rods = []
    for (x, back, up), radius in zip(
        ((25.0, 66, 88), (22.5, 78, 69), (19.5, 89, 51), (16.0, 97, 34)), (4.6, 4.4, 3.9, 3.2), strict=True
    ):
        forward = np.array([0.25, -0.85, -0.45])
        for side in (1, -1):
            middle, ray = np.array([side * x, back, up]), forward * [side, 1, 1]
            holes.append((middle - 7 * ray, middle + 26 * ray, radius))
    canal = np.array([[0.0, 70, 112], [0, 79, 88], [0, 91, 66], [0, 99, 46], [0, 103, 30]])
    return holes + [(a, b, 4.5 - 0.6 * i) for i, (a, b) in enumerate(pairwise(canal))]


def lumbar_centres() -> tuple[Points, Points]:
    """Middle of the bodies of L5 and L4 (2, 3) mm, and their axes (2, 3) pointing up."""
    axes = np.array([[0.0, -np.sin(np.radians(t)), np.cos(np.radians(t))] for t in _LUMBAR_TILT])
    l5 = _PROMONTORY + (_DISC + _BODY_HEIGHT / 2) * axes[0]
    l4 = l5 + (_BODY_HEIGHT / 2) * axes[0] + _DISC * (axes[0] + axes[1]) / 2 + (_BODY_HEIGHT / 2) * axes[1]
    return np.array([l5, l4]), axes


def _body(height: float) -> Points:
    """Vertebral body about the origin: waisted, with rims around its end plates."""
    rows = []
    for level in np.linspace(-1, 1, 7):
        waist = 0.90 + 0.10 * level**2
        edge = 3.0
        ring = []
        for share in np.linspace(0, 1, 5):
            columns = []
            for turn in np.linspace(0, 2 * np.pi, 25):
                x = np.cos(turn) * (_BODY_HALF_WIDTH - edge) * waist
                y = np.sin(turn) * (_BODY_HALF_DEPTH - edge) * waist * (0.82 if np.sin(turn) > 0 else 1.0)
                columns.append([share * x, share * y])
            ring.append(columns)
        dish = 1.6 * level  # the end plates are hollow in the middle
        for share, columns in zip(np.linspace(0, 1, 5), ring, strict=True):
            up = level * (height / 2 - edge) - dish * (1 - share**2)
            rows += [[x, y, up, edge + (0 if abs(level) > 0.9 else 2) * (share < 0.9)] for x, y in columns]
    return np.array(rows)


def vertebra_balls() -> Points:
    """One lumbar vertebra about the middle of its body, axis up, (N, 4)."""
    arch = [
        tube([[13, 11, 5, 5], [16, 22, 5, 5], [16, 30, 2, 5.5]]),  # pedicle
        sheet(
            [
                [[17, 24, 6, 4.2], [30, 27, 9, 3.6], [39, 28, 12, 3.6]],
                [[17, 24, 0, 4], [30, 27, 3, 3.6], [39, 28, 6, 3.6]],
            ]
        ),
        tube([[18, 31, 16, 4.5], [17, 32, 4, 5], [16, 35, -10, 5], [15, 37, -20, 4.5]]),  # articular processes
        sheet([[[16, 32, 5, 3.2], [1, 44, 3, 3.2]], [[15, 36, -10, 3.2], [1, 48, -9, 3.2]]]),  # lamina
    ]
    spine = sheet([[[0, 45, 4, 3], [0, 66, 0, 3.2]], [[0, 48, -10, 3], [0, 68, -14, 4]]])
    return np.concatenate([_body(_BODY_HEIGHT), _mirrored(np.concatenate(arch)), spine])


def lumbar_balls() -> Points:
    """L5 and L4 in place, (N, 4)."""
    placed = []
    for centre, axis in zip(*lumbar_centres(), strict=True):
        balls = vertebra_balls()
        right_handed = np.stack([[1.0, 0, 0], np.cross(axis, [1.0, 0, 0]), axis], 1)
        placed.append(np.c_[balls[:, :3] @ right_handed.T + centre, balls[:, 3]])
    return np.concatenate(placed)


def carve_rods(field: Field, rods: Rods) -> Field:
    """The field without the rods, whose ends are in the frame of the field."""
    for start, end, radius in rods:
        field = field.carved(rod(field.axes(), start, end, radius))
    return field


def sacrum_field(balls: Points, holes: Rods, hips: list[Field]) -> Field:
    """Sacrum in LPS, with its foramina, kept `JOINT_GAP` away from both hip bones."""
    field = carve_rods(ball_union(balls, FIELD_STEP), holes).smoothed(1.4)
    x, y, z = (field.lo[a] + field.step * np.arange(n) for a, n in enumerate(field.values.shape))
    for hip in hips:
        i, j, k = hip.within(x, y, z)
        ilium = hip.on_axes(x[i], y[j], z[k]) - np.float32(JOINT_GAP)
        field.values[i, j, k] = np.maximum(field.values[i, j, k], -ilium)
    return field


def lumbar_field(balls: Points) -> Field:
    """Both vertebrae in LPS."""
    return ball_union(balls, FIELD_STEP).smoothed(1.0)
