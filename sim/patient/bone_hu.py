"""Hounsfield units inside the bones: cortical shell, spongy bone with its texture, marrow canal."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.patient.distance_field import Array, Field
from sim.patient.parameters import PatientParameters
from sim.patient.skeleton import Skeleton
from sim.smoothing import gaussian_filter

Points = NDArray[np.float64]
Voxels = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]
MARROW_HU = -30.0  # fatty marrow


@dataclass(frozen=True, eq=False)
class Texture:
    """What makes spongy bone uneven: fields of mean 0 and deviation 1."""

    grain: Field
    patches: Field


@dataclass(frozen=True, eq=False)
class Axes:
    """Voxel centres of a box in LPS mm, three rising lists."""

    x: Points
    y: Points
    z: Points

    def relative(self, centre: Points) -> tuple[Array, Array, Array]:
        """x, y, z minus `centre` (3,), broadcastable to (X, Y, Z)."""
        x, y, z = (
            (axis - c).astype(np.float32).reshape([-1 if k == j else 1 for j in range(3)])
            for k, (axis, c) in enumerate(zip((self.x, self.y, self.z), centre, strict=True))
        )
        return x, y, z

    def lists(self) -> tuple[Points, Points, Points]:
        """x, y, z."""
        return self.x, self.y, self.z


def smooth_noise(rng: np.random.Generator, lo: Points, hi: Points, sigma_mm: float) -> Field:
    """Gaussian random field of mean 0 and deviation 1 from `lo` to `hi` (3,) mm.

    It has a grid of its own, so that the voxel size of the scan does not alter it.
    """
    step = max(1.0, sigma_mm / 2)
    shape = np.ceil((hi - lo) / step).astype(int) + 2
    noise = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), sigma_mm / step)
    return Field((noise - noise.mean()) / noise.std(), lo, step)


def draw_texture(field: Field, rng: np.random.Generator) -> Texture:
    """The texture of the bone of a distance field."""
    end = field.lo + field.step * (np.array(field.values.shape) - 1)
    return Texture(*(smooth_noise(rng, field.lo, end, sigma_mm) for sigma_mm in (0.8, 5.0)))


def _ramp(x: Array, x0: float, x1: float, y0: float, y1: float) -> Array:
    return (y0 + (y1 - y0) * np.clip((x - x0) / (x1 - x0), 0, 1)).astype(np.float32)


def _materials(
    name: str, points: Sequence[Points], skeleton: Skeleton, texture: Array, grain: Array
) -> tuple[Array | float, Array, Array | float]:
    """Thickness of the cortex mm, HU of spongy bone, HU of cortex at points (N,) each of x, y, z in mm."""
    if name == "sacrum":
        return 1.0, 170 + 0.8 * texture, 850.0
    if name == "vertebrae":
        return 0.9, 180 + 0.7 * texture, 900.0
    side = name.split("_")[1]
    dx, dy, dz = ((p - c).astype(np.float32) for p, c in zip(points, skeleton.heads[side], strict=True))
    radius = skeleton.head_radius
    r = np.sqrt(dx**2 + dy**2 + dz**2)
    if name.startswith("hip"):
        shell = np.where(r < radius + 8, 2.0, _ramp(dz, 20, 70, 1.7, 1.25)).astype(np.float32)
        spongy = _ramp(r, radius + 4, radius + 30, 330, 210) + texture
        return shell, spongy, _ramp(r, radius + 5, radius + 50, 1250, 1050)
    down = -skeleton.lps_from_femur[side][:, 2].astype(np.float32)
    neck = skeleton.neck[side].astype(np.float32)
    below = dx * down[0] + dy * down[1] + dz * down[2]
    along = dx * neck[0] + dy * neck[1] + dz * neck[2]
    under = down - neck * float(down @ neck)  # across the neck, towards its lower side
    under /= np.float32(np.linalg.norm(under))
    across = dx * under[0] + dy * under[1] + dz * under[2]
    shell = _ramp(below, radius - 5, 50, 1.4, 2.2) + _ramp(below, 55, 140, 0, 2.2)
    shell += (
        1.2 * np.clip(across / 12, -0.6, 1.2) * np.exp(-(((along - 38) / 16) ** 2))
    )  # calcar: thick below, thin above
    compressive = np.exp(-((across / 9) ** 2)) * np.exp(-np.clip(r - radius, 0, None) / 12)
    spongy = _ramp(r, 0, radius + 12, 300, 180) + 90 * compressive + texture
    spongy -= 70 * np.exp(-(((along - 42) / 10) ** 2 + ((across + 2) / 10) ** 2))  # Ward's triangle
    hollow = _ramp(below, 62, 110, 0, 1)
    spongy = (1 - hollow) * spongy + hollow * (MARROW_HU + 12 * grain)
    return shell, spongy, _ramp(below, 0, 90, 1150, 1600)


def bone_hu(
    name: str,
    field: Field,
    texture: Texture,
    axes: Axes,
    spacing_mm: float,
    skeleton: Skeleton,
    parameters: PatientParameters,
) -> tuple[Voxels, Array, Array]:
    """Voxels (their indices along x, y, z) that a bone fills, all or in part; that fraction, and HU times it, (N,).

    HU follow what CT of the hip shows: cortex 1050 to 1600, spongy bone of the head 300 to 400, of the trochanter about
    150, fatty marrow -30; the cortex thickness runs from 1.25 mm (iliac wing) to 4.4 mm (shaft).
    """
    box = field.within(*axes.lists())
    depth = -field.across_slices(*(axis[part] for axis, part in zip(axes.lists(), box, strict=True)))
    within = np.nonzero(depth > -spacing_mm / 2)
    x, y, z = (index + part.start for index, part in zip(within[::-1], box, strict=True))
    depth = depth[within]
    grain, patches = (noise.at_voxels(axes.lists(), (x, y, z)) for noise in (texture.grain, texture.patches))
    points = axes.x[x], axes.y[y], axes.z[z]
    thick, spongy, cortex = _materials(name, points, skeleton, 55 * grain + 45 * patches, grain)
    filled = np.clip(depth / spacing_mm + 0.5, 0, 1)
    core = np.clip((depth - thick * parameters.cortex) / spacing_mm + 0.5, 0, 1)
    core = np.minimum(core, filled)
    spongy = MARROW_HU + parameters.bone_density * (np.clip(spongy, -60, 650) - MARROW_HU)
    return (x, y, z), filled, ((filled - core) * (cortex + 60 * patches) + core * spongy).astype(np.float32)
