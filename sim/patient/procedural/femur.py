"""The proximal femur: skeleton about the centre of its head.

Femoral frame: origin at the head's centre, z up along the shaft, x outwards (to the patient's left for the left bone),
y back, before anteversion turns the neck.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.patient.distance_field import Field, ball, ball_union, sheet, tube

Points = NDArray[np.float64]
FIELD_STEP = 1.5
SHAFT_END = 215.0  # mm below the head's centre, beyond every scan


@dataclass(frozen=True)
class FemurShape:
    """Lengths mm, angles degrees; `size` scales trochanters and shaft (1 for a head of 24 mm radius)."""

    head_radius: float
    neck_shaft: float
    anteversion: float
    offset: float
    size: float


def neck_base(shape: FemurShape) -> Points:
    """Where neck and shaft axis meet, (3,) mm, before anteversion."""
    return np.array([shape.offset, 0.0, -shape.offset / np.tan(np.radians(180 - shape.neck_shaft))])


def _turned(points: Points, anteversion: float) -> Points:
    """Points (N, 3) turned about the shaft, so that the neck points forwards from the shaft to the head."""
    angle = np.radians(anteversion)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return points @ turn.T


def neck_axis(shape: FemurShape) -> Points:
    """Unit vector (3,) from the head's centre along the neck, anteversion applied."""
    base = _turned(neck_base(shape)[None], shape.anteversion)[0]
    return base / np.linalg.norm(base)


def femur_balls(shape: FemurShape) -> Points:
    """Skeleton of the left femur about its head, anteversion applied, (N, 4)."""
    s, base = shape.size, neck_base(shape)
    along = base / np.linalg.norm(base)
    across = np.array([-along[2], 0.0, along[0]])  # up and outwards in the plane of the neck
    head = shape.head_radius
    length = float(np.linalg.norm(base))

    def on_neck(share: float, radius: float, high: float) -> list[float]:
        return [*(share * length * along + high * across), radius * s]

    neck = sheet(
        [
            [on_neck(0.1, 0.74 * 24, -2), on_neck(0.1, 0.74 * 24, 1)],
            [on_neck(0.45, 13.2, -3.4), on_neck(0.45, 13.2, 1.4)],
            [on_neck(0.68, 13.2, -5), on_neck(0.68, 13.0, 0)],
            [on_neck(1.0, 15.5, -7), on_neck(1.0, 15.5, 0)],
        ]
    )
    x, z = base[0], base[2]

    def at(dx: float, y: float, dz: float, radius: float) -> list[float]:
        return [x + s * dx, s * y, z + s * dz, s * radius]

    trochanter = sheet(
        [
            [at(2, 13, 22, 6), at(7, 13, 22.5, 7), at(12, 9, 20, 6.5)],
            [at(2, 9, 12, 9.5), at(8, 6, 12, 11), at(15, 1, 10, 10)],
            [at(-2, 5, 0, 14.5), at(6, 3, 0, 14.5), at(13, -1, -2, 13)],
            [at(-2, 2, -14, 16.5), at(3, 2, -14, 16), at(6, 0, -14, 15)],
            [at(0, 1, -34, 16.5), at(0, 1, -34, 16.5), at(1, 0, -34, 16.2)],
        ]
    )
    lesser = tube([at(-6, 8, -27, 9.5), at(-14, 13, -29, 7.5), at(-20, 16, -30, 5.5)])
    medial = tube([at(-14, 2, -6, 11), at(-10, 4, -20, 12), at(-6, 4, -33, 12.5)])
    line = tube([at(-2, 15, -45, 3), at(-1, 14, -70, 3), at(0, 13.5, -130, 2.6)])  # linea aspera
    end = -SHAFT_END - z
    bow = 3.5
    shaft = tube([at(0, 1, -34, 16.5), at(0, 0, -60, 15), at(0, -bow, -110, 14), at(0, -bow, end / s, 13.6)])
    balls = np.concatenate([neck, trochanter, lesser, medial, line, shaft])
    balls = np.r_[balls, [[0, 0, 0, head]]]
    return np.c_[_turned(balls[:, :3], shape.anteversion), balls[:, 3]]


def femur_field(balls: Points, head: Points, head_radius: float) -> Field:
    """Femur in LPS; smoothing rounds the creases, the head itself stays a sphere about `head` (3,)."""
    field = ball_union(balls, FIELD_STEP).smoothed(2.0)
    sphere = ball(field.axes(), head, head_radius)
    return Field(np.minimum(field.values, sphere), field.lo, field.step)
