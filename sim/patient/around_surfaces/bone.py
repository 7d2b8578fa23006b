"""One bone on fine voxels: how much of each it fills, and the HU in it."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.segment.rules import unit
from sim.patient.around_surfaces.voxels import along_axes, block_mean, inside_surface, smooth_noise
from sim.patient.bone_hu import MARROW_HU

Array = NDArray[np.float32]
Points = NDArray[np.float64]

FINE_MM = 0.5  # bones are modelled on this grid and then averaged to the voxels asked for


def model_bone(
    name: str,
    mesh: trimesh.Trimesh,
    low: Points,
    high: Points,
    head: Points,
    radius: float,
    quality: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Filled fraction, and HU times that fraction, [x, y, z] of the fine voxels in the box of whole mm [low, high).

    `head` (3,) and `radius` are those of the femoral head beside the bone, mm; `quality` of 1 is healthy bone.
    """
    counts = ((high - low) / FINE_MM).astype(int)
    half = FINE_MM / 2  # the surface is sampled finer, for partial volume
    filled = block_mean(inside_surface(mesh, low + half / 2, tuple(2 * counts), half))
    depth = ndimage.distance_transform_edt(filled >= 0.5).astype(np.float32) * FINE_MM
    depth = np.maximum(depth - FINE_MM / 2, 0)  # the surface lies between the voxel centres
    relative = [(axis - head[k]).astype(np.float32) for k, axis in enumerate(along_axes(low, counts.tolist(), FINE_MM))]
    axes = _femur_axes(mesh.vertices, head) if name.startswith("femur") else None
    return filled, filled * _bone_hu(name, depth, relative, radius, axes, quality, rng)


def _femur_axes(vertices: Points, head: Points) -> tuple[Points, Points]:
    """Unit vectors down the shaft and across the neck (towards its lower, inner side)."""
    level = vertices[:, 2] - head[2]

    def centre(top: float, bottom: float) -> Points:
        middle: Points = vertices[(level < top) & (level > bottom)].mean(0)
        return middle

    shaft = unit(centre(-240, -280) - centre(-100, -140))
    neck = unit(centre(-100, -140) - shaft * 60 - head)  # from the head to the shaft's axis, about 60 mm below
    return shaft, unit(shaft - neck * (shaft @ neck))


def _ramp(x: Array, x0: float, x1: float, y0: float, y1: float) -> Array:
    values: Array = y0 + (y1 - y0) * np.clip((x - x0) / (x1 - x0), 0, 1)
    return values


def _bone_hu(
    name: str,
    depth: Array,
    relative: Sequence[Array],
    radius: float,
    axes: tuple[Points, Points] | None,
    quality: float,
    rng: np.random.Generator,
) -> Array:
    """HU inside one bone. `depth` is mm below the surface, `relative` x, y, z in mm from the femoral head's centre.

    The thickness of the cortex runs from 1.2 mm (iliac wing) to 4.2 mm (shaft).
    """
    r = np.sqrt(relative[0] ** 2 + relative[1] ** 2 + relative[2] ** 2)
    grain, patches = smooth_noise(depth.shape, 1.4, rng), smooth_noise(depth.shape, 9, rng)
    texture = 55 * grain + 45 * patches
    thick: Array | float
    cortex: Array | float
    if axes is not None:
        shaft, across = (
            (relative[0] * a[0] + relative[1] * a[1] + relative[2] * a[2]).astype(np.float32) for a in axes
        )
        thick = _ramp(shaft, radius - 5, 50, 1.4, 2.2) + _ramp(shaft, 55, 140, 0, 2.0)  # head, neck, shaft
        thick += 0.9 * np.clip(across / 12, -1, 1) * np.exp(-(((r - 38) / 14) ** 2))  # neck: thick below, thin above
        spongy = _ramp(r, 0, radius + 12, 350, 190) + texture
        spongy -= 60 * np.exp(-(((shaft - 38) / 12) ** 2))  # Ward's triangle
        hollow = _ramp(shaft, 65, 115, 0, 1)
        spongy = (1 - hollow) * spongy + hollow * (MARROW_HU + 12 * grain)
        cortex = _ramp(shaft, 0, 90, 1150, 1600)
    elif name.startswith("hip"):
        thick = np.where(r < radius + 7, 2.0, _ramp(relative[2], 20, 70, 1.7, 1.2))  # socket; the iliac wing is thin
        spongy = _ramp(r, radius + 3, radius + 30, 320, 210) + texture
        cortex = _ramp(r, radius + 5, radius + 50, 1250, 1050)
    else:
        thick, spongy, cortex = 0.9, 170 + 0.8 * texture, 850.0
    spongy = MARROW_HU + quality * (np.clip(spongy, -60, 600) - MARROW_HU)
    shell = 1 / (1 + np.exp((depth - thick * np.sqrt(quality)) / 0.3))
    hu: Array = (shell * (cortex + 60 * patches) + (1 - shell) * spongy).astype(np.float32)
    return hu
