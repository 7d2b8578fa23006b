"""Smooth bones from a label map of thick slices.

What is read is a map of hip bones, femora, sacrum and, if it has them, vertebrae, left and right with one id or two, as
segmentations of the pelvis have them. The shape and position of the bones are those of the map.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from femoreg_torch.anatomy import HIP, LabelTable
from femoreg_torch.errors import InputError
from femoreg_torch.segment.sphere import refitted_sphere
from femoreg_torch.volume import Volume
from sim.patient.distance_field import Array, Field
from sim.patient.skeleton import SIDES, Skeleton

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STEP_MM = 1.0  # of the bones' distance fields
_MARGIN_MM = 8.0  # empty space around each bone
_FAR_MM = 8.0  # distances within a slice are cut off here
_EMPTY_MM = 4.0  # and stand at this in a slice without the bone, so that it ends in a round cap
_SMOOTH_MM = 1.2  # standard deviation of the blur that takes the steps off the outlines
_ROUND_MM = 0.8  # and of the one that takes the voxels off the distances
_SYMPHYSIS_GAP_MM = 4.0  # 3 to 5 mm in adults (Becker et al., "The adult human pubic symphysis", J. Anat. 217, 2010)
_ABOVE_MM = 250.0  # spine kept above the femoral heads
_END_MM = 9.0  # a bone that the map cuts off goes on by so much, so that the scan cuts it and no cap is seen
_SHAFT_MM = -80.0  # lower than this against the head's centre, a femur is shaft
_LEAST_SHAFT_MM = 10.0  # of the shaft that are needed to find its axis; with less it counts as upright
_LEAST_FEMUR_MM = 70.0  # below the head's centre: with less the femur ends within its trochanters


def skeleton_from_labels(labels: Volume, table: LabelTable) -> tuple[Skeleton, Points, float]:
    """Bones as smooth distance fields about the middle of the femoral heads.

    Also that middle (3,) in LPS mm, and the height mm, relative to it, at which the map cuts off the femora.
    `table` holds the ids of the bones. Raises `InputError` for a map that does not fit.
    """
    affine = labels.lps_from_index.numpy()
    spacing = np.diag(affine)[:3]
    if not np.allclose(affine[:3, :3], np.diag(spacing)) or spacing.min() <= 0:
        raise InputError("label map: its axes do not run left, back and up. Resample it to LPS first.")
    volume = labels.data.numpy().transpose(2, 1, 0)  # (X, Y, Z)
    grid = _Grid(affine[:3, 3], spacing)
    femora = _left_and_right(_mask(volume, table, "femur_left", "femur_right"))
    hip_bones, sacrum = _mask(volume, table, "hip_left", "hip_right"), _mask(volume, table, "sacrum")
    bones = {f"femur_{side}": _smooth_field(mask, grid) for side, mask in femora.items()}
    both_hips = _smooth_field(hip_bones, grid)
    near = both_hips.surface()
    spheres = {side: _femoral_head(bones[f"femur_{side}"].surface(), near) for side in SIDES}
    heads = {side: sphere[:3] for side, sphere in spheres.items()}
    centre = (heads["left"] + heads["right"]) / 2
    plane = _midplane(np.argwhere(hip_bones) * spacing + grid.origin, heads)
    for side, sign in SIDES.items():
        bones[f"hip_{side}"] = _half(both_hips, plane, sign)
    bones["sacrum"] = _smooth_field(sacrum, grid)
    if "vertebrae" in table:
        top = round((centre[2] + _ABOVE_MM - grid.origin[2]) / spacing[2])
        bones["vertebrae"] = _smooth_field(_mask(volume, table, "vertebrae")[:, :, :top], grid)
    placed = {
        name: Field(bones[name].values, bones[name].lo - centre, bones[name].step)
        for name in HIP.bone_names
        if name in bones
    }
    heads = {side: head - centre for side, head in heads.items()}
    shafts = {side: _femur_axes(placed[f"femur_{side}"], heads[side], sign) for side, sign in SIDES.items()}
    radius = float(np.mean([sphere[3] for sphere in spheres.values()]))
    skeleton = Skeleton(
        placed,
        heads,
        radius,
        np.eye(3),
        {side: axes for side, (axes, _) in shafts.items()},
        {side: neck for side, (_, neck) in shafts.items()},
    )
    lowest = max(np.flatnonzero(mask.any((0, 1)))[0] for mask in femora.values())
    return skeleton, centre, float(lowest * spacing[2] + grid.origin[2] - centre[2])


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxel (i, j, k) of the map lies at origin + spacing * (i, j, k) mm."""

    origin: Points
    spacing: Points


def _mask(volume: NDArray[np.integer], table: LabelTable, *bones: str) -> Mask:
    """The voxels of some bones."""
    for bone in bones:
        if bone not in table:
            raise InputError(f"label map: its table names no id of {bone}. Named are: {', '.join(table)}.")
        if not np.isin(volume, table[bone]).any():
            raise InputError(f"label map: holds no voxel of {bone}, label {', '.join(map(str, table[bone]))}.")
    return np.isin(volume, [n for bone in bones for n in table[bone]])


def _left_and_right(femora: Mask) -> dict[str, Mask]:
    """The two largest parts of the mask, by their x."""
    parts, count = ndimage.label(femora)
    sizes = np.bincount(parts.ravel())[1:]
    if count < 2 or np.sort(sizes)[-2] < 0.3 * sizes.max():
        raise InputError("label map: the femora are not two separate parts.")
    largest = np.argsort(sizes)[-2:] + 1
    left = max(largest, key=lambda n: ndimage.center_of_mass(parts == n)[0])
    return {"left": parts == left, "right": parts == largest[largest != left][0]}


def _smooth_field(mask: Mask, grid: _Grid) -> Field:
    """Signed distance to the bone, mm. Between slices the distances within them are interpolated.

    That is shape-based interpolation (Raya and Udupa, IEEE Trans. Med. Imaging 9, 1990), which leaves no steps where
    the outline moves from slice to slice. A bone that reaches the first or last slice goes on beyond it.
    """
    inside = np.argwhere(mask)
    low, high = inside.min(0), inside.max(0) + 1
    cut = mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    margin = np.ceil(_MARGIN_MM / grid.spacing).astype(int)
    below, above = (_continued(cut_off, grid) for cut_off in (low[2] == 0, high[2] == mask.shape[2]))
    cut = np.pad(cut, [(margin[0],) * 2, (margin[1],) * 2, (0, 0)])
    cut = np.pad(cut, [(0, 0), (0, 0), (below, above)], mode="edge")
    cut = np.pad(cut, [(0, 0), (0, 0), (margin[2],) * 2])
    lo = grid.origin + grid.spacing * (low - margin - [0, 0, below])
    slices = np.stack([_distance_in_slice(cut[:, :, k], grid.spacing[:2]) for k in range(cut.shape[2])], 2)
    axes = [np.arange(0, s * (n - 1) + 1e-6, _STEP_MM) for s, n in zip(grid.spacing, cut.shape, strict=True)]
    stack = PchipInterpolator(grid.spacing[2] * np.arange(cut.shape[2]), slices, axis=2)(axes[2])
    values = _linear(_linear(stack, axes[0] / grid.spacing[0], 0), axes[1] / grid.spacing[1], 1)
    body = ndimage.gaussian_filter(values, _SMOOTH_MM / _STEP_MM) < 0
    distance = ndimage.distance_transform_edt(~body) - ndimage.distance_transform_edt(body)
    distance -= np.sign(distance) * 0.5  # from the middle of a voxel to the face of the next
    return Field((_STEP_MM * distance).astype(np.float32), lo, _STEP_MM).smoothed(_ROUND_MM)


def _continued(cut_off: bool, grid: _Grid) -> int:
    """Slices by which a bone that the map cuts off goes on."""
    return int(np.ceil(_END_MM / grid.spacing[2])) if cut_off else 0


def _distance_in_slice(mask: Mask, spacing: Points) -> Array:
    if not mask.any():
        return np.full(mask.shape, _EMPTY_MM, np.float32)
    distance = ndimage.distance_transform_edt(~mask, spacing) - ndimage.distance_transform_edt(mask, spacing)
    distance -= np.sign(distance) * 0.5 * spacing.mean()
    return np.clip(distance, -_FAR_MM, _FAR_MM).astype(np.float32)


def _linear(values: Array, index: Points, axis: int) -> Array:
    """Values at fractional positions along one axis."""
    below = np.minimum(index.astype(int), values.shape[axis] - 2)
    share = (index - below).reshape([-1 if axis == a else 1 for a in range(3)])
    first = np.take(values, below, axis)
    result: Array = (first + share * (np.take(values, below + 1, axis) - first)).astype(np.float32)
    return result


def _femoral_head(surface: Points, hips: Points) -> Points:
    """Centre and radius (4,) of the sphere through the part of a femur's `surface` that lies in the socket."""
    gap = cKDTree(hips).query(surface)[0]
    return refitted_sphere(surface, gap < np.percentile(gap, 2) + 3)


def _midplane(hips: Points, heads: dict[str, Points]) -> Points:
    """Plane (4,) with n · p = d that parts the hip bones at the symphysis; n points to the left.

    It is the plane near the middle of the femoral heads that runs through least bone of the points `hips` (N, 3).
    """
    across = heads["left"] - heads["right"]
    across /= np.linalg.norm(across)
    middle = (heads["left"] + heads["right"]) / 2
    near = hips[np.abs((hips - middle) @ across) < 30] - middle

    def plane(yaw: float, roll: float, offset: float) -> Points:
        normal = across + np.array([0, yaw, roll])
        normal /= np.linalg.norm(normal)
        return np.r_[normal, offset]

    def bone_on(candidate: Points) -> float:  # the second term keeps the plane in the middle where there is no bone
        return float(np.exp(-(((near @ candidate[:3] - candidate[3]) / 2) ** 2)).sum() + 20 * abs(candidate[3]))

    turns = (-0.1, -0.05, 0.0, 0.05, 0.1)
    best = min((plane(*draw) for draw in product(turns, turns, np.arange(-8.0, 9.0))), key=bone_on)
    return np.r_[best[:3], best[3] + best[:3] @ middle]


def _half(hips: Field, plane: Points, sign: int) -> Field:
    """The hip bone on the left (sign 1) or right (−1) of the plane, half a joint gap away from it."""
    x, y, z = hips.axes()
    beyond = sign * (plane[0] * x + plane[1] * y + plane[2] * z - plane[3])
    values = np.maximum(hips.values, (_SYMPHYSIS_GAP_MM / 2 - beyond).astype(np.float32))
    kept = np.argwhere(values < 0)
    room = int(_MARGIN_MM / hips.step)
    low, high = np.maximum(kept.min(0) - room, 0), kept.max(0) + 1 + room
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return Field(values[box], hips.lo + low * hips.step, hips.step).smoothed(0.8)


def _femur_axes(femur: Field, head: Points, sign: int) -> tuple[Points, Points]:
    """`lps_from_femur` (3, 3), whose third column runs up the shaft, and the neck's direction (3,) from the head."""
    points = np.argwhere(femur.values < 0) * femur.step + femur.lo - head
    if -points[:, 2].min() < _LEAST_FEMUR_MM:
        raise InputError(
            f"label map: the femora end {-points[:, 2].min():.0f} mm below the centres of their heads; "
            f"{_LEAST_FEMUR_MM:.0f} mm are needed."
        )
    up = _shaft_axis(points[points[:, 2] < _SHAFT_MM])
    distance = np.linalg.norm(points, axis=1)
    neck = points[(distance > 25) & (distance < 40)].mean(0)
    neck /= np.linalg.norm(neck)
    left = neck * sign - up * (up @ neck) * sign
    left /= np.linalg.norm(left)
    return np.stack([left, np.cross(up, left), up], 1), neck


def _shaft_axis(shaft: Points) -> Points:
    """Unit vector (3,) up a shaft of points (N, 3); straight up if there is too little of it."""
    if len(shaft) == 0 or np.ptp(shaft[:, 2]) < _LEAST_SHAFT_MM:
        return np.array([0.0, 0.0, 1.0])
    levels = np.unique(np.round(shaft[:, 2], 3))
    middles = np.array([shaft[np.isclose(shaft[:, 2], level)].mean(0) for level in levels])
    up: Points = np.linalg.svd(middles - middles.mean(0), full_matrices=False)[2][0]
    return up * np.sign(up[2])
