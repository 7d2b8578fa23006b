"""A drill path planned by rule: from the lateral cortex along the femoral neck into the centre of the head."""

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume

_NECK_SHELL_MM = (25.0, 40.0)  # distances from the centre of the head at which a femur is neck


_REACH_MM = 150.0  # the lateral cortex is closer to the head than this


_RAY_STEP_MM = 0.25


def neck_axis_entry(labels: Volume, femur: tuple[int, ...], head_centre: Tensor) -> Tensor:
    """Where the axis of the femoral neck leaves the lateral cortex: (3,) in LPS mm.

    The axis runs from the centre of the head (3,) through the centroid of the femur in a spherical shell that holds
    only neck; the entry point is the last point of that ray in the femur. Raises `InputError` if the shell is empty.
    """
    mask = torch.from_numpy(np.isin(labels.data.numpy(), femur))
    index = mask.nonzero().flip(1).to(torch.float64)  # (N, 3), x y z
    affine = labels.lps_from_index
    points = index @ affine[:3, :3].T + affine[:3, 3]
    distance = (points - head_centre).norm(dim=1)
    shell = points[(distance > _NECK_SHELL_MM[0]) & (distance < _NECK_SHELL_MM[1])]
    if len(shell) == 0:
        raise InputError(
            f"landmark FH at {[round(v, 1) for v in head_centre.tolist()]}: no voxel of the femur lies "
            f"{_NECK_SHELL_MM[0]:g} to {_NECK_SHELL_MM[1]:g} mm from it. Check for RAS/LPS mix-ups."
        )
    axis = torch.nn.functional.normalize(shell.mean(0) - head_centre, dim=0)
    ray = head_centre + torch.arange(0, _REACH_MM, _RAY_STEP_MM, dtype=torch.float64)[:, None] * axis
    voxel = (torch.linalg.inv(affine[:3, :3]) @ (ray - affine[:3, 3]).T).T.round().long()
    size = torch.tensor(labels.data.shape[::-1])
    inside = ((voxel >= 0) & (voxel < size)).all(1)
    x, y, z = voxel[inside].unbind(1)
    return ray[inside][mask[z, y, x]][-1]
