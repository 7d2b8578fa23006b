"""The hip between CT and operation: one femur turned about the centre of its head, in the volume itself.

The volume is taken apart into soft tissue (with the bones filled in), the moving femur and the bones at rest. The soft
tissue is bent smoothly around the femur, then the bones are laid over it again with soft edges: the femur rigidly
turned together with its partial-volume rim, the others exactly where they were. Nothing is torn or shown twice, because
no bone ever takes part in the bending.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume
from sim.physics.bone_rims import bone_opacities
from sim.smoothing import gaussian_filter

_FALL_OFF_MM = 30.0  # distance from the femur over which the soft tissue comes to rest
_MARGIN_MM = _FALL_OFF_MM + 2.0
_COARSE_MM = 2.0  # grid of the smooth fields: fill of the bones, bend of the soft tissue

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Matrix = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class _Box:
    """A window on the CT: its first voxel [z, y, x] and, in its own (x, y, z) indices, where the head centre lies."""

    slices: tuple[slice, slice, slice]
    lps_from_index: Matrix
    spacing_zyx: Matrix


def rotate_femur(ct: Volume, labels: Volume, femur: tuple[int, ...], rotation: Tensor, head_centre: Tensor) -> Volume:
    """A CT (HU or densities) after the femur has turned about its head centre by `rotation`, with the tissue around it.

    `labels` lies on the grid of `ct`, 0 where there is no bone; `femur` holds the ids of the femur that moves.
    `rotation` (3, 3) acts in LPS; `head_centre` (3,) in LPS mm. Voxels of other bones keep their values exactly. Raises
    `InputError` if the label map holds no such femur.
    """
    label_array = labels.data.numpy()
    is_femur = np.isin(label_array, femur)
    if not is_femur.any():
        raise InputError(f"labels: no voxel carries a label of the femur ({list(femur)}). Check the ids of the bones.")
    turn, centre = rotation.numpy().astype(np.float64), head_centre.numpy().astype(np.float64)
    box = _box_around(is_femur, ct, turn, centre)
    before = ct.data.numpy()[box.slices]
    moving = is_femur[box.slices]
    resting = (label_array[box.slices] > 0) & ~moving

    femur_alpha, rest_alpha = bone_opacities(moving, resting, box.spacing_zyx)
    matrix, offset = _index_turn(box, turn, centre)
    moved_alpha = ndimage.affine_transform(femur_alpha, matrix, offset, order=1, mode="nearest")

    after = _bent_soft_tissue(before, np.maximum(femur_alpha, rest_alpha), moved_alpha, box, turn, centre)
    part = _where(moved_alpha > 0)
    start = matrix @ [axis.start for axis in part] + offset
    size = after[part].shape
    moved_femur = ndimage.affine_transform(before, matrix, start, output_shape=size, order=3, mode="nearest")
    np.clip(moved_femur, before.min(), before.max(), out=moved_femur)
    after[part] += moved_alpha[part] * (moved_femur - after[part])
    after += rest_alpha * (before - after)
    after[resting] = before[resting]

    data = ct.data.clone()
    data[box.slices] = torch.from_numpy(after)
    return ct.with_data(data)


def _box_around(is_femur: Mask, ct: Volume, turn: Matrix, centre: Matrix) -> _Box:
    """The window that holds the femur before and after its turn, and the tissue that moves with it."""
    spans = [np.flatnonzero(is_femur.any(axis=axes)) for axes in ((0, 1), (0, 2), (1, 2))]  # x, y, z
    lows, highs = np.array([[s[0], s[-1]] for s in spans], float).T
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (highs - lows) + lows
    affine = ct.lps_from_index.numpy()
    points = corners @ affine[:3, :3].T + affine[:3, 3]
    turned = (points - centre) @ turn.T + centre
    index = (np.concatenate([points, turned]) - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
    margin = _MARGIN_MM / np.array(ct.spacing_mm)
    size = np.array(ct.data.shape[::-1])
    low = np.clip(np.floor(index.min(0) - margin), 0, None).astype(int)
    high = np.minimum(np.ceil(index.max(0) + margin).astype(int) + 1, size)
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, :3] @ low
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return _Box((z, y, x), shifted, np.array(ct.spacing_mm)[::-1])


def _where(mask: Mask) -> tuple[slice, slice, slice]:
    """The box of what is set."""
    spans = [np.flatnonzero(mask.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    z, y, x = (slice(int(span[0]), int(span[-1]) + 1) for span in spans)
    return z, y, x


def _index_turn(box: _Box, turn: Matrix, centre: Matrix) -> tuple[Matrix, Matrix]:
    """Matrix and offset that take a [z, y, x] index after the turn to the index that it came from."""
    axes, origin = box.lps_from_index[:3, :3], box.lps_from_index[:3, 3]
    index_from_lps: Matrix = np.linalg.inv(axes)
    middle = index_from_lps @ (centre - origin)
    back = index_from_lps @ turn.T @ axes  # in (x, y, z) order
    return back[::-1, ::-1], (middle - back @ middle)[::-1]


def _bent_soft_tissue(before: Array, bone: Array, moved_femur: Array, box: _Box, turn: Matrix, centre: Matrix) -> Array:
    """The soft tissue alone (bones filled by the tissue near them), carried along by the femur, less so farther off."""
    factor = tuple(float(v) for v in box.spacing_zyx / _COARSE_MM)
    filled = before + bone * (_fill(before, bone, factor) - before)

    shape = tuple(max(2, round(n * f)) for n, f in zip(before.shape, factor, strict=True))
    steps = (np.array(before.shape) - 1) / (np.array(shape) - 1)  # voxels per coarse one
    far = _resized(moved_femur, shape) <= 0.5
    distance = ndimage.distance_transform_edt(far, sampling=steps * box.spacing_zyx)
    weight = gaussian_filter((np.clip(1 - distance / _FALL_OFF_MM, 0, 1) ** 2).astype(np.float32), 1.5)

    axes, origin = box.lps_from_index[:3, :3], box.lps_from_index[:3, 3]
    index = np.indices(shape).reshape(3, -1).T * steps
    arm = index[:, ::-1] @ axes.T + origin - centre  # from the head centre, mm
    turns = Rotation.from_rotvec(-weight.reshape(-1, 1) * Rotation.from_matrix(turn).as_rotvec())
    shift = (turns.apply(arm) - arm) @ np.linalg.inv(axes).T  # in voxels, to where the tissue comes from

    coordinates = np.empty((3, *before.shape), np.float32)
    for axis in range(3):
        coordinates[axis] = _resized(shift[:, 2 - axis].reshape(shape), before.shape)
        coordinates[axis] += np.arange(before.shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
    bent: Array = ndimage.map_coordinates(filled, coordinates, order=1, mode="nearest")
    return bent


def _fill(before: Array, bone: Array, factor: tuple[float, ...]) -> Array:
    """Values for the places of bones: averages of the soft tissue around, ever wider ones (normalised convolution)."""
    shape = tuple(max(2, round(n * f)) for n, f in zip(before.shape, factor, strict=True))
    share = _resized(1 - bone, shape)
    share[share < 0.9] = 0
    values = _resized(before, shape) * share
    fill, known = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for width_mm in (3.0, 9.0, 27.0):
        sigma = width_mm / _COARSE_MM
        weight = gaussian_filter(share, sigma)
        average = gaussian_filter(values, sigma) / np.maximum(weight, 1e-6)
        trust = np.clip(weight / 0.1, 0, 1) * (1 - known)
        fill += trust * average
        known += trust
    return _resized(fill / np.maximum(known, 1e-6), before.shape)


def _resized(array: NDArray[Any], shape: tuple[int, ...]) -> Array:
    """Trilinear resampling to another shape, corner voxels onto corner voxels."""
    tensor = torch.from_numpy(np.ascontiguousarray(array, np.float32))[None, None]
    return torch.nn.functional.interpolate(tensor, size=shape, mode="trilinear", align_corners=True)[0, 0].numpy()
