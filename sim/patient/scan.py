"""The CT scan of a skeleton in soft tissue, and its label map."""

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.volume.grid import Volume, axis_aligned
from sim.patient.bone_hu import Axes, Texture, bone_hu, draw_texture
from sim.patient.distance_field import Array
from sim.patient.parameters import PatientParameters
from sim.patient.skeleton import LABEL_IDS, Skeleton
from sim.patient.soft_tissue import AIR_HU, SoftTissue, make_soft_tissue
from sim.smoothing import gaussian_filter

Points = NDArray[np.float64]
Labels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
BLUR_MM = 0.5  # standard deviation of the scanner's point spread
NOISE_HU = 15.0  # at 1 mm; noise falls with the square root of the voxel size
_TILE = 16


@dataclass(frozen=True, eq=False)
class Patient:
    """One synthetic patient; landmarks (3,) float64 LPS mm in the order of the anatomy's."""

    ct: Volume
    labels: Volume
    landmarks: dict[str, Tensor]
    parameters: dict[str, float]


def _box(skeleton: Skeleton, parameters: PatientParameters, bottom_mm: float) -> tuple[Points, Points]:
    """Corners (3,) in whole mm, with room for the soft tissue and air around it."""
    lows, highs = [], []
    for field in skeleton.bones.values():
        lows.append(field.lo)
        highs.append(field.lo + field.step * (np.array(field.values.shape) - 1))
    lo, hi = np.min(lows, axis=0), np.max(highs, axis=0)
    room = 22 + 18 * parameters.habitus
    lo -= [room + 24, room + 12, 0]
    hi += [room + 24, room + 18, -4]
    lo[2] = bottom_mm
    return np.floor(lo), np.ceil(hi)


def _around_body(tissue: SoftTissue, lo: Points, hi: Points) -> tuple[Points, Points]:
    """The box without its empty margins left, right, front and back, but for 6 mm; whole mm."""
    body = np.argwhere(tissue.depth.values > 0)
    low = np.floor(tissue.depth.lo + tissue.depth.step * body.min(0)) - 6
    high = np.ceil(tissue.depth.lo + tissue.depth.step * body.max(0)) + 6
    return np.r_[np.maximum(lo, low)[:2], lo[2]], np.r_[np.minimum(hi, high)[:2], hi[2]]


@dataclass(frozen=True, eq=False)
class _Body:
    """All that is drawn of a patient but the noise of a scan, so that every scan shows the same."""

    skeleton: Skeleton
    parameters: PatientParameters
    textures: dict[str, Texture]
    tissue: SoftTissue
    lo: Points  # corners (3,) of what is scanned, mm
    hi: Points


def _draw_body(
    skeleton: Skeleton, parameters: PatientParameters, bottom_mm: float, seeds: Sequence[np.random.SeedSequence]
) -> _Body:
    """`seeds` are those of the soft tissue, and of the texture of each bone."""
    tissue_seed, *bone_seeds = seeds
    lo, hi = _box(skeleton, parameters, bottom_mm)
    tissue = make_soft_tissue(lo, hi, skeleton, parameters, np.random.default_rng(tissue_seed))
    lo, hi = _around_body(tissue, lo, hi)
    textures = {
        name: draw_texture(field, np.random.default_rng(seed))
        for (name, field), seed in zip(skeleton.bones.items(), bone_seeds, strict=True)
    }
    return _Body(skeleton, parameters, textures, tissue, lo, hi)


def _place_bones(body: _Body, axes: Axes, spacing: float, hu: Array, filled: Array, labels: Labels) -> None:
    """Put bones into arrays (Z, Y, X) of zeros: HU times filled fraction, that fraction, and labels."""
    for name, field in body.skeleton.bones.items():
        voxels, part, part_hu = bone_hu(name, field, body.textures[name], axes, spacing, body.skeleton, body.parameters)
        _put(*voxels, part, part_hu, LABEL_IDS[name], hu, filled, labels)


@nb.njit(cache=True, parallel=True)
def _put(x, y, z, part, part_hu, label, hu, filled, labels):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Put one bone into the volumes; what other bones fill of a voxel is theirs, and the greatest share names it."""
    for n in nb.prange(len(part)):  # each voxel once
        at = z[n], y[n], x[n]
        before = filled[at]
        share = min(part[n], 1 - before) / max(part[n], np.float32(1e-6))
        if part[n] >= 0.5 and part[n] > before:
            labels[at] = label
        filled[at] += part[n] * share
        hu[at] += part_hu[n] * share


def _record(hu: Array, air: Mask, spacing: float, rng: np.random.Generator) -> None:
    """What the scanner makes of HU (Z, Y, X), in place: blur, noise, whole numbers. Noise is drawn slab by slab."""
    gaussian_filter(hu, BLUR_MM / spacing, out=hu)
    depth, height, width = hu.shape
    slab = max(1, int(32 / spacing))
    drawn = np.empty(width * height * min(slab, depth), np.float32)  # one for all slabs: to touch new memory takes long
    for low in range(0, depth, slab):
        part = slice(low, min(low + slab, depth))
        noise = drawn[: width * height * (part.stop - low)].reshape(width, height, -1)
        rng.standard_normal(out=noise, dtype=np.float32)
        gaussian_filter(noise, 0.55, out=noise)
        _add_noise(hu[part], air[part], noise, np.float32(NOISE_HU / np.sqrt(spacing) / noise.std()))


@nb.njit(cache=True, parallel=True)
def _add_noise(hu, air, noise, scale):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Add scaled noise (X, Y, Z) to HU (Z, Y, X) and round them; where air is nothing is but air."""
    depth, height, width = hu.shape
    low, high = np.float32(-1024), np.float32(3071)
    for y in nb.prange(height):
        for left in range(0, width, _TILE):  # a few lines of noise at a time stay in the processor's cache
            for z in range(depth):
                for x in range(left, min(left + _TILE, width)):
                    value = np.rint(hu[z, y, x] + scale * noise[x, y, z])
                    hu[z, y, x] = np.float32(AIR_HU) if air[z, y, x] else min(max(value, low), high)


def scan_skeleton(
    skeleton: Skeleton,
    parameters: PatientParameters,
    bottom_mm: float,
    seeds: Sequence[np.random.SeedSequence],
    spacings_mm: Sequence[float],
) -> list[tuple[Volume, Volume]]:
    """Scans of a skeleton in soft tissue, down to `bottom_mm` from the femoral heads, for each of some voxel sizes.

    Each is a CT in HU and its labels (by `LABEL_IDS`). Of `parameters` the bone density, the cortex and the habitus
    count; `seeds` are those of soft tissue, noise, and the texture of each bone.
    """
    tissue_seed, noise_seed, *bone_seeds = seeds
    body = _draw_body(skeleton, parameters, bottom_mm, [tissue_seed, *bone_seeds])
    return [_scan(body, spacing_mm, np.random.default_rng(noise_seed)) for spacing_mm in spacings_mm]


def _scan(body: _Body, spacing: float, rng: np.random.Generator) -> tuple[Volume, Volume]:
    axes = Axes(*(np.arange(body.lo[k] + spacing / 2, body.hi[k], spacing) for k in range(3)))
    shape = len(axes.z), len(axes.y), len(axes.x)
    hu, filled, labels = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    _place_bones(body, axes, spacing, hu, filled, labels)
    air = body.tissue.fill_in(axes, hu, filled)
    del filled
    _record(hu, air, spacing, rng)
    lps_from_index = axis_aligned((spacing,) * 3, (float(axes.x[0]), float(axes.y[0]), float(axes.z[0])))
    return Volume(torch.from_numpy(hu), lps_from_index), Volume(torch.from_numpy(labels), lps_from_index)
