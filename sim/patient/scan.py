"""The CT scan of a skeleton in soft tissue, and its label map."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from femoreg_torch.volume.grid import Volume, axis_aligned
from sim.patient.bone_hu import Axes, bone_hu
from sim.patient.distance_field import Array
from sim.patient.parameters import PatientParameters
from sim.patient.skeleton import LABEL_IDS, Skeleton
from sim.patient.soft_tissue import AIR_HU, SoftTissue, make_soft_tissue

Points = NDArray[np.float64]
BLUR_MM = 0.5  # standard deviation of the scanner's point spread
NOISE_HU = 15.0  # at 1 mm; noise falls with the square root of the voxel size


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


def _place_bones(
    axes: Axes, spacing: float, skeleton: Skeleton, parameters: PatientParameters, seeds: list[np.random.SeedSequence]
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Bone HU times filled fraction, that fraction, and labels, (X, Y, Z) each."""
    lists = (axes.x, axes.y, axes.z)
    shape = tuple(len(a) for a in lists)
    hu, filled, labels = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for (name, field), seed in zip(skeleton.bones.items(), seeds, strict=True):
        box = field.within(*lists)
        part_axes = Axes(*(a[s] for a, s in zip(lists, box, strict=True)))
        part, part_hu = bone_hu(name, field, part_axes, spacing, skeleton, parameters, np.random.default_rng(seed))
        room = 1 - filled[box]  # where two bones share a voxel they cannot fill more than all of it
        share = np.minimum(part, room) / np.maximum(part, 1e-6)
        labels[box][(part >= 0.5) & (part > filled[box])] = LABEL_IDS[name]
        filled[box] += part * share
        hu[box] += part_hu * share
    return hu, filled, labels


def _scan(hu: Array, filled: Array, axes: Axes, spacing: float, tissue: SoftTissue, rng: np.random.Generator) -> None:
    """Fill soft tissue into `hu` in place, then blur, add noise and round to whole HU; slab by slab to spare memory."""
    slab = max(1, int(32 / spacing))
    slabs = [slice(k, k + slab) for k in range(0, len(axes.z), slab)]
    air = []
    for part in slabs:
        soft, depth = tissue.hu(Axes(axes.x, axes.y, axes.z[part]))
        hu[:, :, part] += (1 - filled[:, :, part]) * soft
        air.append(depth < -2.5)
    ndimage.gaussian_filter(hu, BLUR_MM / spacing, output=hu)
    for part, outside in zip(slabs, air, strict=True):
        noise = rng.standard_normal(outside.shape, dtype=np.float32)
        ndimage.gaussian_filter(noise, 0.55, output=noise)
        hu[:, :, part] += noise * np.float32(NOISE_HU / np.sqrt(spacing) / noise.std())
        hu[:, :, part][outside] = AIR_HU
    np.clip(np.rint(hu, out=hu), -1024, 3071, out=hu)


def scan_skeleton(
    skeleton: Skeleton,
    parameters: PatientParameters,
    bottom_mm: float,
    seeds: list[np.random.SeedSequence],
    spacing_mm: float,
) -> tuple[Volume, Volume]:
    """CT in HU and labels (by `LABEL_IDS`) of a skeleton in soft tissue, down to `bottom_mm` from the femoral heads.

    Of `parameters` the bone density, the cortex and the habitus count; `seeds` are those of soft tissue, noise, and
    the texture of each bone.
    """
    tissue_seed, noise_seed, *bone_seeds = seeds
    lo, hi = _box(skeleton, parameters, bottom_mm)
    tissue = make_soft_tissue(lo, hi, skeleton, parameters, np.random.default_rng(tissue_seed))
    lo, hi = _around_body(tissue, lo, hi)
    axes = Axes(*(np.arange(lo[k] + spacing_mm / 2, hi[k], spacing_mm) for k in range(3)))
    hu, filled, labels = _place_bones(axes, spacing_mm, skeleton, parameters, bone_seeds)
    _scan(hu, filled, axes, spacing_mm, tissue, np.random.default_rng(noise_seed))
    lps_from_index = axis_aligned((spacing_mm,) * 3, (float(axes.x[0]), float(axes.y[0]), float(axes.z[0])))

    def volume(values: Array | NDArray[np.uint8]) -> Volume:
        return Volume(torch.from_numpy(np.ascontiguousarray(values.transpose(2, 1, 0))), lps_from_index)

    return volume(hu), volume(labels)
