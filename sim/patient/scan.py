"""A procedural patient in the scanner: CT, labels, landmarks. Everything is computed, no data file is read."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume import HIP_LANDMARKS
from femoreg_torch.volume.grid import Volume, axis_aligned
from sim.patient.bone import Axes, bone_hu
from sim.patient.landmarks import find_landmarks
from sim.patient.parameters import PatientParameters, draw_parameters
from sim.patient.sdf import Array
from sim.patient.skeleton import LABELS, Skeleton, build_skeleton
from sim.patient.tissue import AIR_HU, SoftTissue, make_soft_tissue

Points = NDArray[np.float64]
BELOW_MM = 190.0  # femur in the scan below the heads
BLUR_MM = 0.5  # standard deviation of the scanner's point spread
NOISE_HU = 15.0  # at 1 mm; noise falls with the square root of the voxel size


@dataclass(frozen=True, eq=False)
class Patient:
    """One synthetic patient; landmarks (3,) float64 LPS mm in the order of `HIP_LANDMARKS`."""

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
        labels[box][(part >= 0.5) & (part > filled[box])] = LABELS[name]
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


def make_patient(seed: int, spacing_mm: float = 1.0) -> Patient:
    """Patient of one seed: the same seed gives the same bits, and the same patient at every voxel size.

    Args:
        seed: not negative.
        spacing_mm: voxel size, 0.5 to 2 mm.

    Returns:
        CT in HU and labels (1 left hip, 2 right, 3 vertebrae, 4 sacrum, 5 left femur, 6 right) on one grid
        along the LPS axes, whose origin lies midway between the femoral heads; landmarks in LPS mm; parameters.
    """
    return make_scans(seed, (spacing_mm,))[0]


def make_scans(seed: int, spacings_mm: Sequence[float]) -> list[Patient]:
    """The patient of one seed at several voxel sizes, as `make_patient` gives each."""
    if seed < 0:
        raise InputError(f"patient: seed is {seed}, expected 0 or more.")
    for spacing_mm in spacings_mm:
        if not 0.5 <= spacing_mm <= 2:
            raise InputError(f"patient: spacing is {spacing_mm} mm, expected 0.5 to 2 mm.")
    shape_seed, *scan_seeds = np.random.SeedSequence(seed).spawn(3 + len(LABELS))
    shape_rng = np.random.default_rng(shape_seed)
    parameters = draw_parameters(shape_rng)
    skeleton = build_skeleton(parameters, shape_rng)
    landmarks = find_landmarks(skeleton)
    points = {name: torch.from_numpy(landmarks[name].copy()) for name in HIP_LANDMARKS}
    numbers = {k: float(v) for k, v in asdict(parameters).items()}
    scans = [scan_skeleton(skeleton, parameters, -BELOW_MM, scan_seeds, spacing_mm) for spacing_mm in spacings_mm]
    return [Patient(ct, labels, points, numbers) for ct, labels in scans]


def scan_skeleton(
    skeleton: Skeleton,
    parameters: PatientParameters,
    bottom_mm: float,
    seeds: list[np.random.SeedSequence],
    spacing_mm: float,
) -> tuple[Volume, Volume]:
    """CT in HU and labels (as in `LABELS`) of a skeleton in soft tissue, down to `bottom_mm` from the femoral heads.

    Of `parameters` the bone density, the cortex and the habitus count; `seeds` are those of soft tissue, noise, and
    each bone's texture.
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
