"""Where the structures of a label map are."""

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume.grid import Volume, changes_in_place

Corner = tuple[int, int, int]  # x, y, z
_Boxes = list[tuple[slice, slice, slice] | None]
# Of the labels of a map, and the version of the data that they were found in.
_boxes: WeakKeyDictionary[Volume, tuple[int, _Boxes]] = WeakKeyDictionary()


def looked_up(table: NDArray[Any], labels: NDArray[Any]) -> NDArray[Any]:
    """The entries of a table (n,) that labels (Z, Y, X) of whole numbers below n stand for.

    OpenCV looks bytes up ten times as fast as NumPy.
    """
    if labels.dtype != np.uint8:
        return table[labels]
    whole = np.zeros(256, table.dtype)
    whole[: len(table)] = table[:256]
    return np.asarray(cv2.LUT(np.ascontiguousarray(labels).reshape(len(labels), -1), whole)).reshape(labels.shape)


def label_box(labels: Volume, ids: Sequence[int]) -> tuple[Corner, Corner]:
    """Index bounds (x, y, z) of the voxels with these labels, low inclusive, high exclusive.

    Raises `InputError` if none of the ids occurs.
    """
    version, boxes = _boxes.get(labels, (-1, []))
    if version != changes_in_place(labels.data):
        boxes = ndimage.find_objects(labels.data.numpy())
        _boxes[labels] = changes_in_place(labels.data), boxes
    found = [box for n in ids if n <= len(boxes) and (box := boxes[n - 1]) is not None]
    if not found:
        raise InputError(f"label map: no voxel carries any of the labels {list(ids)}. Check `ct.bones` against it.")
    x, y, z = ((min(box[axis].start for box in found), max(box[axis].stop for box in found)) for axis in (2, 1, 0))
    return (x[0], y[0], z[0]), (x[1], y[1], z[1])


def label_box_centre(labels: Volume, ids: Sequence[int]) -> Tensor:
    """Middle (3,), mm, of the bounding box of a structure's voxels. For the pelvis this is the paper's centre PC.

    Raises `InputError` if none of the ids occurs.
    """
    lo, hi = (torch.tensor(corner, dtype=torch.float64) for corner in label_box(labels, ids))
    return transform_points(labels.lps_from_index, ((lo + hi - 1) / 2)[None])[0]
