"""Bone told from the rest of a CT without a network: bright sheets, and the cheapest surface around what they enclose.

After Krčah, Székely and Blanc, "Fully automatic and fast segmentation of the femur bone from 3D-CT images with no shape
prior" (ISBI 2011): the CT is sharpened, a measure of sheets at several scales (Descoteaux et al., "Bone enhancement
filtering", Computer Aided Surgery 11, 2006) marks thin cortex, and a graph cut (Boykov and Funka-Lea, IJCV 70, 2006)
decides the rest. Marrow is as dark as what lies outside of bones; what tells it here is how well bone encloses it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

Mask = NDArray[np.bool_]
Values = NDArray[np.float32]
Capacities = NDArray[np.int32]

SCALES_MM = (0.75, 1.0, 1.5)  # standard deviations
_SHARPER, _SHARPER_MM = 2.0, 1.0  # how much of what a blur of that standard deviation takes away is added
_FLAT, _STRONG = 0.5, 0.5  # of exp(−(|λ₂|/|λ₃|)²/…²) and 1 − exp(−(Σ|λ|/mean)²/…²)
_NEAR_HU, _NEAR_VOXELS = 150.0, 5  # sheets are looked for in boxes of so many voxels around what is so bright
_BONE_HU, _SHEET, _SHEET_HU = 350.0, 0.4, 150.0  # surely bone: as bright as this, or a sheet and as bright as that
_LEAST_ML = 0.5  # of a part that is surely bone
_REACH_MM = 30.0  # along each of 26 directions, in which bone is looked for
_OPEN = 0.5  # with bone in less of the directions a voxel is outside; 0.35 to 0.5 are met beside a flat bone
_ENCLOSED, _MARROW_HU = 0.75, 80.0  # what pulls neither way
_BY_ENCLOSURE, _BY_HU, _HU_RANGE = 1.5, 0.5, 150.0  # pull of a voxel, in faces of the surface
_DROP = 0.2  # of sheetness, over which a surface becomes cheap
_UNIT = 100  # capacity of a face with no edge
BONE, OUTSIDE, UNDECIDED, APART = 1, 2, 0, 3  # where a voxel stands before a cut; what is apart has no links


@dataclass(frozen=True, eq=False)
class Links:
    """Capacities of the faces along one axis (z, y or x): (n − 1) along it."""

    onwards: Capacities  # of the face between a voxel, which is bone, and the next one, which is not
    backwards: Capacities


def sheetness(hu: Values, spacing_mm: float, where: Mask, scales_mm: Sequence[float] = SCALES_MM) -> Values:
    """How sheet-like (Z, Y, X) is around each voxel of `where`: towards 1 bright sheets, towards −1 dark ones, else 0.

    sign(−λ₃) · exp(−(|λ₂|/|λ₃|)²/0.5²) · (1 − exp(−(Σ|λ|/mean)²/0.5²)) of the eigenvalues |λ₁| ≤ |λ₂| ≤ |λ₃| of the
    Hessian, the strongest of all scales. Krčah's third factor, of tubes, is left out: in tubes and blobs |λ₂| is |λ₃|,
    and the first one is 0.02. `spacing_mm` is that of cubic voxels.
    """
    strongest = np.zeros(int(where.sum()), np.float32)
    for scale in scales_mm:
        smallest, middle, largest = _eigenvalues(hu, scale / spacing_mm, where)
        size = np.abs(smallest) + np.abs(middle) + np.abs(largest)
        flat = np.exp(-((middle / np.where(largest == 0, 1, largest)) ** 2) / _FLAT**2)
        strong = 1 - np.exp(-((size / max(1e-9, float(size.mean()))) ** 2) / _STRONG**2)
        found = -np.sign(largest) * flat * strong
        strongest = np.where(np.abs(found) > np.abs(strongest), found, strongest)
    result = np.zeros(hu.shape, np.float32)
    result[where] = strongest
    return result


def _eigenvalues(hu: Values, sigma: float, where: Mask) -> Values:
    """Eigenvalues (3, N) of the Hessian of the blurred values at the voxels of `where`, by rising size.

    In closed form (Smith, Comm. ACM 4, 1961), thirty times as fast as `numpy.linalg.eigvalsh`.
    """
    second = ((0, 0, 2), (0, 2, 0), (2, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0))
    xx, yy, zz, xy, xz, yz = (ndimage.gaussian_filter(hu, sigma, order, truncate=3)[where] for order in second)
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    radius = np.sqrt(np.maximum((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6, 1e-20))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2 * radius**3), -1, 1)) / 3
    high, low = mean + 2 * radius * np.cos(angle), mean + 2 * radius * np.cos(angle + 2 * np.pi / 3)
    values = np.stack([high, 3 * mean - high - low, low])
    ordered: Values = np.take_along_axis(values, np.argsort(np.abs(values), 0), 0)
    return ordered


def bone_of(hu: Values, spacing_mm: float) -> tuple[Mask, Values]:
    """All bone (Z, Y, X) with its marrow, narrow joint spaces among it, and the sheetness that it was found by."""
    sharp = hu + _SHARPER * (hu - ndimage.gaussian_filter(hu, _SHARPER_MM / spacing_mm))
    sheets = sheetness(sharp, spacing_mm, np.asarray(ndimage.maximum_filter(hu > _NEAR_HU, _NEAR_VOXELS), bool))
    sure = (hu > _BONE_HU) | ((sheets > _SHEET) & (hu > _SHEET_HU))
    parts, _ = ndimage.label(sure)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    sure = (sizes * spacing_mm**3 / 1000 > _LEAST_ML)[parts]
    share = enclosure(sure, spacing_mm)
    stand = np.where(sure, BONE, np.where(share < _OPEN, OUTSIDE, UNDECIDED)).astype(np.uint8)
    pull = _BY_ENCLOSURE * (share - _ENCLOSED) + _BY_HU * ((hu - _MARROW_HU) / _HU_RANGE).clip(-1, 1)
    links = [_links_of_sheets(sheets, axis) for axis in range(3)]
    return minimum_cut(stand, (_UNIT * pull).astype(np.int32), links), sheets


def _links_of_sheets(sheets: Values, axis: int) -> Links:
    """A surface is cheap where sheetness falls from bone to what lies outside of it."""
    fall = -np.diff(sheets, axis=axis)
    edge = (_UNIT * np.exp(-np.abs(fall) / _DROP)).astype(np.int32) + 1
    return Links(np.where(fall > 0, edge, _UNIT).astype(np.int32), np.where(fall < 0, edge, _UNIT).astype(np.int32))


def enclosure(bone: Mask, spacing_mm: float) -> Values:
    """Share (Z, Y, X) of 26 directions along which bone is met within 30 mm. What the volume cuts goes on beyond it."""
    count = [-(-n // 2) for n in bone.shape]
    even = np.pad(bone, [(0, 2 * c - n) for c, n in zip(count, bone.shape, strict=True)])
    coarse = even.reshape([n for c in count for n in (c, 2)]).any((1, 3, 5))
    room = int(_REACH_MM / (2 * spacing_mm))
    padded = np.pad(coarse, room, mode="edge")
    total = np.zeros(coarse.shape, np.uint8)
    inner = (slice(room, -room),) * 3
    for direction in product((-1, 0, 1), repeat=3):
        if not any(direction):
            continue
        steps = int(_REACH_MM / (2 * spacing_mm * float(np.linalg.norm(direction))))
        met, reached = _moved(padded, direction, 1), 1
        while reached < steps:  # twice as far each time
            further = min(reached, steps - reached)
            met = met | _moved(met, direction, further)
            reached += further
        total += met[inner]
    share = (total / np.float32(26)).astype(np.float32)
    z, y, x = (np.arange(n) // 2 for n in bone.shape)
    return share[np.ix_(z, y, x)]


def _moved(mask: Mask, direction: tuple[int, ...], steps: int) -> Mask:
    """What lies so many voxels further in a direction; beyond the border there is nothing."""
    result = np.zeros_like(mask)
    moves = [steps * d for d in direction]
    there = tuple(slice(max(0, m), n + min(0, m)) for m, n in zip(moves, mask.shape, strict=True))
    here = tuple(slice(max(0, -m), n + min(0, -m)) for m, n in zip(moves, mask.shape, strict=True))
    result[here] = mask[there]
    return result


def minimum_cut(stand: NDArray[np.uint8], pull: Capacities, links: Sequence[Links]) -> Mask:
    """What is bone (Z, Y, X): that which stood so, and the undecided voxels on its side of the cheapest surface.

    The cost of a surface is the sum of the capacities of its faces (`links` along z, y and x) and of the pulls against
    it: `pull` of an undecided voxel is what it costs to leave it outside, or, if negative, to take it. The maximum flow
    is SciPy's (Dinic), over the undecided voxels alone.
    """
    undecided = stand == UNDECIDED
    count = int(undecided.sum())
    bone = stand == BONE
    if not count:
        return bone
    number = np.full(stand.shape, -1, np.int32)
    number[undecided] = np.arange(count, dtype=np.int32)
    towards_bone = np.maximum(pull[undecided], 0).astype(np.int64)
    towards_outside = np.maximum(-pull[undecided], 0).astype(np.int64)
    start, end, capacity = [], [], []
    for axis, link in enumerate(links):
        low, high = (tuple(s if k == axis else slice(None) for k in range(3)) for s in (slice(-1), slice(1, None)))
        both = undecided[low] & undecided[high]
        start += [number[low][both], number[high][both]]
        end += [number[high][both], number[low][both]]
        capacity += [link.onwards[both], link.backwards[both]]
        for own, other, leaving, coming in (
            (low, high, link.onwards, link.backwards),
            (high, low, link.backwards, link.onwards),
        ):
            beside = undecided[own] & (stand[other] == BONE)
            np.add.at(towards_bone, number[own][beside], coming[beside])
            beside = undecided[own] & (stand[other] == OUTSIDE)
            np.add.at(towards_outside, number[own][beside], leaving[beside])
    either = np.minimum(towards_bone, towards_outside)
    towards_bone -= either
    towards_outside -= either
    source, sink = count, count + 1
    first, last = np.flatnonzero(towards_bone), np.flatnonzero(towards_outside)
    start += [np.full(len(first), source), last]
    end += [first, np.full(len(last), sink)]
    capacity += [towards_bone[first], towards_outside[last]]
    ends = (np.concatenate(start).astype(np.int32), np.concatenate(end).astype(np.int32))
    graph = sparse.csr_matrix((np.concatenate(capacity).astype(np.int32), ends), shape=(count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = np.zeros(count + 2, bool)
    reached[breadth_first_order(left, source, return_predecessors=False)] = True
    bone[undecided] = reached[:count]
    return bone
