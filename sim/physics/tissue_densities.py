"""A CT split for imaging: soft tissue on coarse voxels, bone on the CT's own, movable bones by themselves.

Soft tissue and cortical bone make up a voxel (`sim.physics.materials.tissue_densities`) such that, from muscle to
cortical bone, ρ_water + κ ρ_bone is one constant, with κ = `WATER_PER_BONE`: that of muscle. So this *filled* density
has no edges where bones have theirs. It can be imaged on coarse voxels and coarse pixels, and bent around a turned
femur there, while the bones, on fine voxels, move rigidly. Along a ray, mass per area of water is that of the filled
density less κ times that of bone.
"""

from collections.abc import Sequence

import numba as nb
import numpy as np
import torch
from torch import Tensor

from femoreg_torch.volume import Volume, crop
from femoreg_torch.volume.labels import label_box
from sim.physics.bone_rims import RIM_MM, bone_opacities
from sim.physics.materials import WATER_PER_BONE, tissue_densities
from sim.smoothing import gaussian_filter

COARSE_MM = 1.5  # about the voxels of the filled density
_BONE_HU = 200.0  # denser voxels count as bone also where nothing is labelled


def separate(
    ct: Volume, labels: Volume, movable: Sequence[tuple[int, ...]]
) -> tuple[Volume, Volume, list[Volume], Volume]:
    """Filled density, density of the bone at rest, those of the `movable` bones (labels of each), and coarse labels.

    `ct` is in HU, `labels` on its grid; all densities are in g/cm³ where the CT has them. Raises `InputError` if the
    label map lacks one of the bones.
    """
    factor = max(1, round(COARSE_MM / min(ct.spacing_mm)))
    filled, bone, names = _densities(ct, labels, factor)
    moving = [_cut_out(bone, names, ids) for ids in movable]
    return filled, bone, moving, Volume(_middles(labels.data, factor), filled.lps_from_index)


def _coarse_affine(volume: Volume, factor: int) -> Tensor:
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3].sum(1) * (factor - 1) / 2
    affine[:3, :3] *= factor
    return affine


def _middles(data: Tensor, factor: int) -> Tensor:
    z, y, x = (slice(factor // 2, n // factor * factor, factor) for n in data.shape)
    return data[z, y, x].contiguous()


def _densities(ct: Volume, labels: Volume, factor: int) -> tuple[Volume, Volume, Volume]:
    """The filled density on blocks of `factor` voxels, the density of bone on the CT's voxels, cropped, and its labels.

    Bone is what is labelled or dense, with its partial-volume rim. Elsewhere all is soft tissue: what noise lifts above
    the HU of muscle there is no bone. What fills no whole block at the far faces is left out.
    """
    hu, known = ct.data.numpy(), np.zeros([n // factor for n in ct.data.shape], np.float32)
    _mark_bone(hu, labels.data.numpy(), np.float32(_BONE_HU), factor, known)
    sigma = RIM_MM / factor / np.array(ct.spacing_mm[::-1])
    near = gaussian_filter(known, sigma, truncate=3)
    opacity = np.maximum(np.clip(near / np.float32(0.15), 0, 1), known)
    spans = [np.flatnonzero((opacity > 0).any(axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    first, end = ([int(span[at]) for span in spans] for at in (0, -1))
    # interpolation fades out over one block more
    low = [max(0, n - 1) * factor for n in first]
    high = [min(n + 2, size) * factor for n, size in zip(end, known.shape, strict=True)]

    lowest, highest = int(hu.min()) - 1, int(hu.max()) + 1
    soft, dense = (density.numpy() for density in tissue_densities(torch.arange(lowest, highest + 1.0)))
    filled, bone = np.empty_like(known), np.zeros([b - a for a, b in zip(low, high, strict=True)], np.float32)
    saved = np.float32(1 - WATER_PER_BONE)
    _split(hu, opacity, soft + dense, dense, lowest, saved, factor, np.array(low), filled, bone)
    names = crop(labels, (low[2], low[1], low[0]), (high[2], high[1], high[0]))
    return Volume(torch.from_numpy(filled), _coarse_affine(ct, factor)), names.with_data(torch.from_numpy(bone)), names


@nb.njit(cache=True, parallel=True)
def _mark_bone(hu, labels, dense_hu, factor, known):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Set `known` to 1 for blocks that hold a labelled or dense voxel."""
    for k in nb.prange(known.shape[0]):
        for z in range(k * factor, (k + 1) * factor):
            for y in range(known.shape[1] * factor):
                for x in range(known.shape[2] * factor):
                    if labels[z, y, x] > 0 or hu[z, y, x] > dense_hu:
                        known[k, y // factor, x // factor] = 1


@nb.njit(cache=True, parallel=True)
def _split(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    hu, opacity, totals, denses, lowest, saved, factor, low, filled, bone
):
    """Fill in `filled` (a value per block) and `bone` (per voxel, its first one at `low` [z, y, x]).

    `totals` and `denses` hold the densities of all tissue and of bone for every HU from `lowest` on. `opacity` is the
    share of bone that is believed, per block, and interpolated. `saved` is 1 − κ.
    """
    depth, height, width = filled.shape
    for k in nb.prange(depth):
        around = np.empty(width, np.float32)
        for j in range(height):
            around[:] = 0  # the highest opacity of the row and its eight neighbours
            for p in range(max(k - 1, 0), min(k + 2, depth)):
                for q in range(max(j - 1, 0), min(j + 2, height)):
                    for i in range(width):
                        around[i] = max(around[i], opacity[p, q, i])
            for i in range(width):
                near = around[i] > 0 or around[max(i - 1, 0)] > 0 or around[min(i + 1, width - 1)] > 0
                mean = 0.0
                for z in range(k * factor, (k + 1) * factor):
                    for y in range(j * factor, (j + 1) * factor):
                        for x in range(i * factor, (i + 1) * factor):
                            entry = round(hu[z, y, x]) - lowest
                            total = totals[entry]
                            if near and denses[entry] > 0:
                                dense = denses[entry] * _trilinear(opacity, z, y, x, factor)
                                bone[z - low[0], y - low[1], x - low[2]] = dense
                                total -= saved * dense
                            mean += total
                filled[k, j, i] = mean / factor**3


@nb.njit(cache=True)
def _trilinear(blocks, z, y, x, factor):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Value at a voxel between the middles of blocks; beyond the outermost ones, theirs."""
    c = np.float32((z + 0.5) / factor - 0.5), np.float32((y + 0.5) / factor - 0.5), np.float32((x + 0.5) / factor - 0.5)
    k, j, i = int(np.floor(c[0])), int(np.floor(c[1])), int(np.floor(c[2]))
    value = np.float32(0)
    for dz in range(2):
        for dy in range(2):
            for dx in range(2):
                weight = (1 - abs(c[0] - k - dz)) * (1 - abs(c[1] - j - dy)) * (1 - abs(c[2] - i - dx))
                p = min(max(k + dz, 0), blocks.shape[0] - 1)
                q = min(max(j + dy, 0), blocks.shape[1] - 1)
                r = min(max(i + dx, 0), blocks.shape[2] - 1)
                value += weight * blocks[p, q, r]
    return value


def _cut_out(bone: Volume, labels: Volume, ids: tuple[int, ...]) -> Volume:
    """Take one bone (by its label ids) with its rim out of `bone`, in place; returns it as a volume of its own."""
    margin = [int(3 * RIM_MM / s) + 2 for s in bone.spacing_mm]
    low, high = label_box(labels, ids)
    low = (max(0, low[0] - margin[0]), max(0, low[1] - margin[1]), max(0, low[2] - margin[2]))
    high = (high[0] + margin[0], high[1] + margin[1], high[2] + margin[2])
    part, names = crop(bone, low, high), crop(labels, low, high).data.numpy()
    mask = np.isin(names, ids)
    opacity = torch.from_numpy(bone_opacities(mask, (names > 0) & ~mask, np.array(bone.spacing_mm)[::-1])[0])
    moving = part.data * opacity
    x, y, z = (slice(a, b) for a, b in zip(low, high, strict=True))
    bone.data[z, y, x] -= moving
    return part.with_data(moving)
