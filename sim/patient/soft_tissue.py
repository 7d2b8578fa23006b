"""Everything but bone: muscle with its fat planes, fat, skin, bowel with gas, bladder, rectum, air."""

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.patient.bone_hu import Axes, smooth_noise
from sim.patient.distance_field import Array, Field
from sim.patient.parameters import PatientParameters
from sim.patient.skeleton import SIDES, Skeleton

Points = NDArray[np.float64]
STEP_MM = 2.5
SKIN_MM = 2.0
AIR_HU = -1000.0
_SKIN_HU = 15.0
_CLEAR_MM = 2.5  # beyond the skin


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """Body on a coarse grid: mm beneath the skin (negative outside), mm of fat, HU beneath the fat, HU of the fat."""

    depth: Field
    fat: Field
    inner_hu: Field
    fat_hu: Field

    def fill_in(self, axes: Axes, hu: Array, filled: Array) -> NDArray[np.bool_]:
        """Add soft tissue to the HU (Z, Y, X) of bone, `filled` of each voxel; returns which voxels (Z, Y, X) are air.

        These lie clear of the skin, so that no blur of it reaches them.
        """
        fields = (self.depth, self.fat, self.inner_hu, self.fat_hu)  # on one grid
        values = np.stack([np.ascontiguousarray(field.values.T) for field in fields])
        i, u, j, v, k, w = self.depth.places(axes.x, axes.y, axes.z)
        air = np.empty(hu.shape, bool)
        _fill_in(values, k, w, j, v, i, u, filled, hu, air)
        return air


@nb.njit(cache=True, parallel=True)
def _fill_in(values, k, w, j, v, i, u, filled, hu, air):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """See `SoftTissue.fill_in`. `values` (4, Z, Y, X) holds depth, fat, HU within, HU of the fat.

    Voxels lie between nodes k and k + 1 along z, at the share w of the way, and so on for the other axes.
    """
    half, skin, beyond = np.float32(0.5), np.float32(SKIN_MM), np.float32(-_CLEAR_MM)
    for z in nb.prange(len(k)):
        planes = values[:, k[z]] + w[z] * (values[:, k[z] + 1] - values[:, k[z]])
        for y in range(len(j)):
            depths, fats, inners, fat_hus = planes[:, j[y]] + v[y] * (planes[:, j[y] + 1] - planes[:, j[y]])
            for x in range(len(i)):
                n, share = i[x], u[x]
                depth = depths[n] + share * (depths[n + 1] - depths[n])
                soft = np.float32(AIR_HU)
                if depth >= skin:
                    fat = fats[n] + share * (fats[n + 1] - fats[n])
                    inner = inners[n] + share * (inners[n + 1] - inners[n])
                    fat_hu = fat_hus[n] + share * (fat_hus[n + 1] - fat_hus[n])
                    muscle = min(max((depth - fat) / np.float32(1.5) + half, np.float32(0)), np.float32(1))
                    soft = muscle * inner + (1 - muscle) * fat_hu
                elif depth >= 0:
                    soft = np.float32(_SKIN_HU)
                hu[z, y, x] += (1 - filled[z, y, x]) * soft
                air[z, y, x] = depth < beyond


def _noise(rng: np.random.Generator, axes: Axes, sigma_mm: float) -> Array:
    """Gaussian random field (X, Y, Z) on the coarse grid."""
    lo, hi = (np.array([axis[k] for axis in (axes.x, axes.y, axes.z)]) for k in (0, -1))
    return smooth_noise(rng, lo, hi, sigma_mm).on_axes(axes.x, axes.y, axes.z)


def _super_ellipse(u: Array, v: Array, power: float) -> Array:
    return (np.abs(u) ** power + np.abs(v) ** power).astype(np.float32)


def _muscle_envelope(axes: Axes, skeleton: Skeleton) -> NDArray[np.bool_]:
    """Trunk and thighs without their fat."""
    x, y, z = axes.relative(np.zeros(3))
    hips = [skeleton.bones[f"hip_{side}"].surface() for side in SIDES]
    sacrum = skeleton.bones["sacrum"].surface()
    crest = max(float(np.abs(h[h[:, 2] > 60, 0]).max()) for h in hips)
    front = min(float(h[:, 1].min()) for h in hips) - 8
    rear = float(sacrum[:, 1].max()) + 8
    heads = float(np.abs(skeleton.heads["left"][0])) + skeleton.head_radius * 3.0 + 12
    wide = np.interp(z, [0, 70, 130, 200], [heads, (heads + crest + 14) / 2, crest + 8, crest]).astype(np.float32)
    middle, deep = (front + rear) / 2, (rear - front) / 2
    floor = np.clip((-25 - z) / 90, 0, 1)  # perineum and buttocks round off the lower end of the trunk
    body = _super_ellipse(x / wide, (y - middle) / deep, 2.6) + floor**1.5 < 1
    for side, sign in SIDES.items():
        head, up = skeleton.heads[side], skeleton.lps_from_femur[side][:, 2]
        level = (z - head[2]) / up[2]
        centre_x = head[0] + level * up[0] + sign * np.interp(z, [-200, -40, 40], [22, 30, 34])
        centre_y = head[1] + level * up[1] + 10
        half = np.interp(z, [-230, -60, 10, 50], [60, 70, 66, 20]).astype(np.float32)
        body |= _super_ellipse((x - centre_x) / half, (y - centre_y) / (1.12 * half), 2.3) < 1
    return ndimage.gaussian_filter(body.astype(np.float32), 3) > 0.5


def _viscera(axes: Axes, skeleton: Skeleton, rng: np.random.Generator) -> tuple[NDArray[np.bool_], Array]:
    """Mask of pelvic and abdominal cavity, and the HU in it."""
    x, y, z = axes.relative(np.zeros(3))
    half = abs(float(skeleton.heads["left"][0]))
    belly = (x / (1.05 * half)) ** 2 + ((y + 5) / 58) ** 2 + (np.clip(140 - z, 0, None) / 85) ** 2 < 1
    cavity = (x / (0.62 * half)) ** 2 + ((y - 22) / 55) ** 2 + ((z - 45) / 66) ** 2 < 1
    loops = _noise(rng, axes, 9)
    gas_from = rng.uniform(1.1, 2.0)  # some bowels hold much gas, some hardly any
    hu = np.where(loops > 0.1, 38, -100).astype(np.float32)
    hu = np.where(loops > gas_from, -820, hu)
    full = rng.uniform(0.7, 1.25)
    bladder = (x / (36 * full)) ** 2 + ((y - 2) / (27 * full)) ** 2 + ((z - 20) / (24 * full)) ** 2
    hu = np.where(bladder < 1.15, 45, hu)
    hu = np.where(bladder < 1, 6, hu)
    rectum = ((x - 6 * np.sin(z / 25)) / 17) ** 2 + ((y - 52 - 8 * np.sin(z / 40)) / 15) ** 2
    near = np.abs(z - 40) < 45
    hu = np.where((rectum < 1) & near, 30, hu)
    hu = np.where((rectum < 0.3) & near & (_noise(rng, axes, 8) > 0.2), -800, hu)
    return belly | cavity, hu.astype(np.float32)


def _two_nearest_bones(axes: Axes, skeleton: Skeleton) -> tuple[Array, Array]:
    """Distance mm to the nearest bone and to the second nearest (X, Y, Z), 100 where none is near."""
    nearest, second = (np.full((len(axes.x), len(axes.y), len(axes.z)), 100, np.float32) for _ in range(2))
    for field in skeleton.bones.values():
        i, j, k = field.within(axes.x, axes.y, axes.z)
        here = field.on_axes(axes.x[i], axes.y[j], axes.z[k])
        second[i, j, k] = np.minimum(second[i, j, k], np.maximum(nearest[i, j, k], here))
        nearest[i, j, k] = np.minimum(nearest[i, j, k], here)
    return nearest, second


def make_soft_tissue(
    lo: Points, hi: Points, skeleton: Skeleton, parameters: PatientParameters, rng: np.random.Generator
) -> SoftTissue:
    """Soft tissue of the box from `lo` to `hi` (3,) LPS mm. Muscle 52 HU, fat -95, bowel wall 38, gas -820, urine 6."""
    counts = np.ceil((hi - lo) / STEP_MM).astype(int) + 1
    axes = Axes(*(lo[k] + STEP_MM * np.arange(counts[k]) for k in range(3)))
    _, y, z = axes.relative(np.zeros(3))
    muscle = _muscle_envelope(axes, skeleton)
    bone, second = _two_nearest_bones(axes, skeleton)
    muscle |= bone < 5
    within = ndimage.distance_transform_edt(muscle) - ndimage.distance_transform_edt(~muscle)
    within = ndimage.gaussian_filter((within * STEP_MM).astype(np.float32), 1.5)
    fat = parameters.habitus * (
        11 + 7 * np.clip(y / 80, 0, 1) + 5 * np.clip((z - 40) / 100, 0, 1) * np.clip(-y / 60, 0, 1)
    )
    fat = np.maximum(fat + 2.5 * _noise(rng, axes, 25), 4).astype(np.float32)
    inner = 52 + 6 * _noise(rng, axes, 4) + 4 * _noise(rng, axes, 12)
    inner[np.abs(_noise(rng, axes, 9)) < 0.06 + 0.05 * parameters.habitus] = -75  # fat planes between the muscles
    cavity, viscera = _viscera(axes, skeleton, rng)
    cavity &= (within > 14) & (bone > 6)
    inner[cavity] = viscera[cavity]
    inner[(second < 2.6) & (bone > -1)] = 95  # cartilage, discs
    fat_hu = (-95 + 6 * _noise(rng, axes, 5)).astype(np.float32)
    fields = (within + fat, fat, inner.astype(np.float32), fat_hu)
    depth, fat_field, inner_field, fat_hu_field = (Field(values.astype(np.float32), lo, STEP_MM) for values in fields)
    return SoftTissue(depth, fat_field, inner_field, fat_hu_field)
