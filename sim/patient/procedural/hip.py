"""The hip bone: a skeleton in the frame of a standard pelvis, and the field carved from it.

Standard pelvis: mm, x to the patient's left, y back, z up, in the anterior pelvic plane's frame; origin midway between
the femoral heads, whose centres lie at x = ±90 and whose radius is 24. All shapes below are the left bone.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sim.patient.distance_field import Field, ball, ball_union, sheet, tube

Points = NDArray[np.float64]
Warp = Callable[[Points], Points]
Tube = Sequence[Sequence[float]]  # control balls x, y, z, radius
Sheet = Sequence[Tube]

HEAD = np.array([90.0, 0.0, 0.0])
HEAD_RADIUS = 24.0
JOINT_GAP = 3.8  # mm between the bones of the joint: two layers of cartilage
SYMPHYSIS_GAP = 4.6
OPENING = np.array([0.72, -0.27, -0.64])  # where the socket looks: outwards, forwards, down
FIELD_STEP = 1.25
ROUNDING = 1.2

# x, y, z, radius; rows from the socket's roof up to the crest, columns from front to back
_WING: Sheet = [
    [[98, -25, 31, 8], [95, -13, 34, 10.5], [90, 2, 35, 12.5], [84, 13, 36, 12], [78, 23, 37, 9], [75, 30, 38, 5.5]],
    [[108, -33, 46, 6], [103, -19, 48, 8], [96, -4, 50, 10.5], [87, 10, 50, 11.5], [78, 22, 50, 9], [72, 34, 49, 5]],
    [[121, -46, 67, 5.5], [114, -29, 67, 5], [104, -10, 68, 5], [91, 8, 68, 6.5], [72, 36, 66, 10], [63, 70, 60, 4.5]],
    [[130, -41, 89, 6], [123, -22, 90, 3.4], [110, -1, 90, 2.4], [92, 18, 90, 3.4], [71, 53, 88, 9.5], [56, 92, 83, 5]],
    [[135, -19, 115, 6], [127, -3, 115, 3], [112, 15, 115, 2], [95, 33, 114, 2.6], [75, 57, 110, 7], [67, 85, 104, 6]],
    [
        [131, 1, 127, 5],
        [123, 13, 135, 5],
        [111, 28, 139, 4.6],
        [99, 43, 138, 4.6],
        [86, 60, 130, 5.8],
        [77, 76, 118, 6],
    ],
]
# joint face towards the sacrum, flat and sagittal: rows from top to bottom, columns from front to back
_AURICULAR: Sheet = [
    [[67, 43, 97, 4.5], [66, 55, 98, 6.5], [63, 70, 98, 6]],
    [[65, 38, 80, 4.5], [64, 52, 82, 6.5], [60, 70, 82, 6]],
    [[67, 36, 66, 5], [64, 50, 66, 6], [59, 64, 65, 5]],
]
# the flat inner wall behind the socket: rows from top to bottom, columns from front to back
_INNER_WALL: Sheet = [
    [[74, -15, 24, 6], [69, -3, 27, 5], [69, 10, 29, 6], [71, 22, 31, 8], [73, 31, 33, 6]],
    [[65, -20, 9, 6], [60, -8, 10, 3], [60, 8, 10, 3], [62, 24, 10, 7], [65, 36, 10, 6]],
    [[63, -19, -3, 5], [59, -9, -3, 2.8], [59, 8, -5, 3.4], [62, 24, -6, 8], [65, 40, -6, 6]],
]
# the brim of the lesser pelvis, from the sacral joint to the pubis
_BRIM: Tube = [[66, 38, 68, 5], [69, 28, 54, 5.5], [69, 18, 42, 5.2], [65, 6, 31, 5], [61, -8, 22, 5], [56, -18, 13, 5]]
_ISCHIUM: Sheet = [
    [[69, 12, -8, 6], [73, 25, -8, 10], [69, 39, -7, 6.5]],
    [[68, 15, -20, 7], [73, 29, -21, 11], [69, 42, -20, 7]],
    [[66, 20, -33, 7.5], [72, 33, -34, 10.5], [69, 46, -33, 8]],
    [[64, 24, -44, 7.5], [69, 35, -46, 10], [66, 45, -45, 8]],
    [[57, 25, -54, 5.5], [60, 32, -57, 7], [61, 38, -56, 7]],
]
_SPINE: Tube = [[64, 36, 4, 6], [60, 45, 0, 4.8], [54.5, 53, -3, 2.4]]
_UPPER_RAMUS: Tube = [
    [82, -16, 22, 9],
    [71, -19, 15, 9.8],
    [60, -22, 7, 10],
    [50, -26, 0, 9],
    [40, -30, -7, 8],
    [28, -33.5, -13.5, 8],
    [15, -35, -19.5, 8.6],
]
_PECTEN: Tube = [[60, -16, 14, 4], [50, -20, 8, 4], [39, -25, 1, 3.6], [28, -31, -6, 3.8], [19, -37, -11.5, 4.6]]
# under the socket the ramus is a blade that rounds off the upper corner of the foramen
_OBTURATOR_CREST: Sheet = [
    [[70, -10, 4, 4], [61, -17, 0, 5], [50, -24, -4, 6]],
    [[68, 2, -8, 4.5], [61, -8, -7, 3.6], [49, -20, -10, 4.5]],
]
_PUBIC_BODY: Sheet = [
    [[8, -37, -20, 8], [15, -35, -20.5, 8.6], [26, -31, -19, 8]],
    [[8, -31, -28, 7.5], [14, -28, -28, 7.5], [26, -24, -25, 6.8]],
    [[7, -23, -35, 5.6], [14, -18, -36, 5.8], [20, -16, -34, 4.8]],
]
_LOWER_RAMUS: Sheet = [
    [[11, -21, -39, 4.4], [17, -17, -32, 4.2]],
    [[21, -10, -47, 4.4], [28, -8, -38, 4.4]],
    [[33, 2, -54, 4.4], [39, 3, -45, 4.6]],
    [[45, 14, -58, 4.8], [50, 13, -48, 5]],
    [[56, 27, -59, 6], [60, 24, -45, 6]],
]
_SPINES: list[Tube] = [
    [[121, -46, 68, 5.5], [124, -48, 75, 5.8], [129, -43, 85, 6]],  # anterior superior
    [[98, -25, 28, 7.5], [102, -31, 35, 7], [107, -32, 42, 6.5]],  # anterior inferior
    [[60, 86, 80, 5.5], [53, 94, 82, 4.6]],  # posterior superior
]


def _socket() -> Points:
    """A bowl around the head, thick at the roof and the back, thin inside, open below where the notch is."""
    opening = OPENING / np.linalg.norm(OPENING)
    side = np.cross(opening, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, opening)
    inner = HEAD_RADIUS + JOINT_GAP
    balls = []
    for polar in np.radians(np.arange(0, 86, 3.0)):
        for turn in np.arange(0, 2 * np.pi, np.radians(3) / max(np.sin(polar), 0.05)):
            ray = -np.cos(polar) * opening + np.sin(polar) * (np.cos(turn) * up + np.sin(turn) * side)
            notch = polar > np.radians(42) and np.cos(turn) < -0.80
            if notch:
                continue
            thick = 2.6 + 4.4 * np.clip(ray[2], 0, 1) + 4.2 * np.clip(ray[1], 0, 1) + 0.8 * np.clip(-ray[1], 0, 1)
            thick *= 1 - 0.45 * np.clip((polar - np.radians(66)) / np.radians(20), 0, 1)
            balls.append([*(HEAD + (inner + thick) * ray), thick])
    return np.array(balls)


def hip_balls() -> Points:
    """Skeleton of the standard left hip bone, (N, 4)."""
    sheets = (_WING, _AURICULAR, _INNER_WALL, _ISCHIUM, _OBTURATOR_CREST, _PUBIC_BODY, _LOWER_RAMUS)
    tubes = (_BRIM, _SPINE, _UPPER_RAMUS, _PECTEN, *_SPINES)
    return np.concatenate([_socket(), *(sheet(rows) for rows in sheets), *(tube(balls) for balls in tubes)])


def warped(balls: Points, warp: Warp) -> Points:
    """Balls (N, 4) with moved centres."""
    return np.c_[warp(balls[:, :3]), balls[:, 3]]


def hip_field(balls: Points, head: Points, head_radius: float, lps_from_pelvis: Points, side: int) -> Field:
    """Field of one hip bone in LPS.

    `balls` (N, 4) and `head` (3,) are in LPS; `lps_from_pelvis` (3, 3) turns the pelvic frame about the origin, on
    whose middle plane the symphyseal faces are cut flat, `SYMPHYSIS_GAP` apart; `side` is +1 for the left bone.
    """
    field = ball_union(balls, FIELD_STEP).smoothed(ROUNDING)
    x, y, z = field.axes()
    field = field.carved(ball((x, y, z), head, head_radius + JOINT_GAP))
    across = (side * lps_from_pelvis[:, 0]).astype(np.float32)
    return field.carved(x * across[0] + y * across[1] + z * across[2] - np.float32(SYMPHYSIS_GAP / 2))
