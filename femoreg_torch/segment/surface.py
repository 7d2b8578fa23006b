"""The surface of a bone in a label map."""

import numpy as np
import torch
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume

STEP_MM = 1.5  # of the grid that surfaces are drawn on; edges are then at most its diagonal
_EDGE = 0.5  # of what is inside, blurred
_SMOOTH_MM = 1.0  # standard deviation of the blur that takes the voxels off a surface


def bone_surface(labels: Volume, number: int) -> trimesh.Trimesh:
    """The closed surface of a label, LPS mm, on nodes of 1.5 mm, its voxels smoothed off.

    Raises `InputError` for a label that is too thin for one.
    """
    inside = torch.nonzero(labels.data == number)
    low, high = inside.min(0).values, inside.max(0).values + 1
    part = (labels.data[low[0] : high[0], low[1] : high[1], low[2] : high[2]] == number).numpy().astype(np.float32)
    spacing = np.array(labels.spacing_mm)[::-1]
    room = np.ceil((3 * _SMOOTH_MM + 1) / spacing).astype(int)
    smooth = ndimage.gaussian_filter(np.pad(part, [(n, n) for n in room]), _SMOOTH_MM / spacing)
    zoom = spacing / STEP_MM
    if (np.abs(zoom - 1) > 0.1).any():
        counts = np.maximum(2, np.round((np.array(smooth.shape) - 1) * zoom).astype(int) + 1)
        axes = [np.linspace(0, n - 1, count) for n, count in zip(smooth.shape, counts, strict=True)]
        steps = [axis[1] for axis in axes]
        smooth = ndimage.map_coordinates(smooth, np.meshgrid(*axes, indexing="ij"), order=1)
    else:
        steps = [1.0] * 3
    if not smooth.max() > _EDGE:
        mm = " × ".join(f"{n * s:.2g}" for n, s in zip((high - low).flip(0).tolist(), labels.spacing_mm, strict=True))
        raise InputError(
            f"label map: what label {number} has, {mm} mm in all, is too small or thin for a bone. Check it, and the "
            "size of the voxels, which is to be in mm."
        )
    vertices, faces, _, _ = marching_cubes(smooth, _EDGE)
    index = vertices * steps - room + low.numpy()
    affine = labels.lps_from_index.numpy()
    mesh = trimesh.Trimesh(index[:, ::-1] @ affine[:3, :3].T + affine[:3, 3], faces, process=False)
    parts = mesh.split(only_watertight=False)
    return max(parts, key=lambda part: len(part.faces)) if len(parts) else mesh
