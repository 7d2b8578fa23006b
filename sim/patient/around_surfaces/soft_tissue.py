"""Everything but bone, on voxels of 1 mm: muscle, fat, skin, bowel with gas, bladder, rectum, air."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.patient.around_surfaces.trunk import Surfaces, Trunk, thigh_outline
from sim.patient.around_surfaces.voxels import along_axes, smooth_noise
from sim.patient.skeleton import SIDES

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Points = NDArray[np.float64]


def make_soft_tissue(
    low: Points,
    bone: Array,
    bones: Surfaces,
    trunk: Trunk,
    landmarks: dict[str, Points],
    draw: Callable[[int], np.random.Generator],
) -> tuple[Array, Mask]:
    """HU of everything but bone [x, y, z], and the mask of the body.

    `low` (3,) is the lower corner, mm, and `bone` the filled fraction; `draw` gives the generator of each random field.
    """
    counts = bone.shape
    x, y, z = along_axes(low, counts, 1.0)
    left, back = (row[0] * x + row[1] * y for row in trunk.turn.astype(np.float32))
    number = iter(range(100))

    def field(sigma: float) -> Array:
        return smooth_noise(counts, sigma, draw(next(number)))

    body = _body(x, y, z, left, back, bone, bones, trunk)
    skin = ndimage.distance_transform_edt(body).astype(np.float32)
    fat = 13 + 9 * np.clip((back - trunk.centre) / 100, 0, 1) + 2.5 * field(25)
    muscle = 52 + 5 * field(2) + 4 * field(12)
    muscle[(np.abs(field(11)) < 0.085) & (bone == 0)] = -75  # fat planes between the muscles
    hu = np.where(skin < fat, -95 + 6 * field(4), muscle)
    hu[skin < 2] = 15
    cavity, viscera = _viscera(left, back, z, bone, skin, bones, trunk, landmarks, field)
    hu[cavity] = viscera[cavity]
    hu[~body] = -1000
    return hu.astype(np.float32), body


def _body(
    x: Points, y: Points, z: Points, left: Points, back: Points, bone: Array, bones: Surfaces, trunk: Trunk
) -> Mask:
    """Trunk and thighs with their fat and skin."""
    wide = (trunk.wide * np.interp(z, [0, 60, 160], [1, 0.95, 0.9])).astype(np.float32)
    deep = (trunk.deep * np.interp(z, [0, 60, 160], [1, 1, 0.96])).astype(np.float32)
    lowest = min(bones["hip_left"].bounds[0, 2], bones["hip_right"].bounds[0, 2])
    floor = np.clip((lowest + 45 - z) / 90, 0, 1)  # perineum and buttocks: rounded lower end of the trunk
    body = np.abs(left / wide) ** 2.6 + np.abs((back - trunk.centre) / deep) ** 2.6 + floor**1.5 < 1
    for side, sign in SIDES.items():
        inner, outer, ty, ry = thigh_outline(bones[f"femur_{side}"], z)
        body |= np.abs((sign * x - (inner + outer) / 2) / (outer - inner) * 2) ** 2.4 + np.abs((y - ty) / ry) ** 2.4 < 1
    smooth: Mask = ndimage.gaussian_filter(body.astype(np.float32), 5) > 0.5
    smooth |= ndimage.binary_dilation(bone > 0, iterations=8)
    return smooth


def _viscera(
    left: Points,
    back: Points,
    z: Points,
    bone: Array,
    skin: Array,
    bones: Surfaces,
    trunk: Trunk,
    landmarks: dict[str, Points],
    field: Callable[[float], Array],
) -> tuple[Mask, NDArray[np.floating]]:
    """Mask of pelvic and abdominal cavity, and the HU in it."""
    sacrum = bones["sacrum"].vertices
    rear = sacrum[(sacrum[:, :2] @ trunk.turn[1]).argmax()]
    pubis = (landmarks["SPS-l"], landmarks["SPS-r"])
    behind = back - np.mean([trunk.turn[1] @ point[:2] for point in (*pubis, rear, rear)])
    belly = (left / 95) ** 2 + ((back - trunk.centre + 18) / 62) ** 2 + (np.clip(130 - z, 0, None) / 85) ** 2 < 1
    cavity = (left / 56) ** 2 + (behind / 56) ** 2 + ((z - 42) / 62) ** 2 < 1
    cavity = (cavity | belly) & (skin > 24) & (ndimage.distance_transform_edt(bone == 0) > 6)
    loops = field(10)
    inside = np.where(loops > 0.1, 38, -100)  # bowel in fat, some of it filled with gas
    inside = np.where(loops > 1.45, -820, inside)
    bladder = (left / 38) ** 2 + ((behind + 18) / 28) ** 2 + ((z - 24) / 26) ** 2
    inside = np.where(bladder < 1.15, 45, inside)
    inside = np.where(bladder < 1, 6, inside)
    rectum = (left / 17) ** 2 + ((behind - 34) / 15) ** 2
    near = np.abs(z - 42) < 45
    inside = np.where((rectum < 1) & near, 30, inside)
    inside = np.where((rectum < 0.3) & near & (field(9) > 0), -800, inside)
    return cavity, inside
