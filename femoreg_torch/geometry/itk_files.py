"""Rigid transforms in files of ITK and 3D Slicer: `.tfm`, `.txt`, `.mat`, `.h5`."""

from pathlib import Path

import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError
from femoreg_torch.geometry.rigid import check_rigid, invert_rigid, rigid


def read_itk_transform(path: Path) -> Tensor:
    """`b_from_a` (4, 4), float64, LPS mm, of a file in ITK's direction, which takes points of b to a.

    3D Slicer saves a transform so: under `b_from_a` a model of frame a appears in frame b. Raises `InputError` for what
    is no rigid transform in 3-D.
    """
    try:
        with quiet():
            transform = sitk.ReadTransform(str(path))
    except (RuntimeError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split()).rpartition("): ")[2][:200]
        raise InputError(f"{path}: cannot be read as an ITK transform ({reason}).") from error
    if transform.GetDimension() != 3 or not transform.IsLinear():
        raise InputError(f"{path}: a rigid transform in 3D was expected, found {transform.GetName()}.")
    origin, *axes = (
        torch.tensor(transform.TransformPoint(point), dtype=torch.float64)
        for point in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    a_from_b = rigid(torch.stack([axis - origin for axis in axes], 1), origin)
    return invert_rigid(check_rigid(a_from_b, str(path)))
