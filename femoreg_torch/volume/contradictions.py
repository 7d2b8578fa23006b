"""Do the grey values of a CT and a label map belong to one another?"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numba
import numpy as np
import torch
from scipy import fft
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3, transform_points
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.labels import label_box
from femoreg_torch.volume.resample import crop

_MEDIANS_MM, _SHIFTS_MM = 3.0, 2.0  # apart are the voxels that are looked at, or as far as the CT's own
# HU. Of right CTs, sparse bone and bones without soft tissue too: labels 30 to 700 in the median, what lies 6 to 9 mm
# beside them −1000 to 110. With the intercept of −1024 applied twice, labels −770; never applied, beside them 1070.
# Bones of plastic foam are as light, but their shells are not: of real ones the densest twentieth then has −380 to 290.
_LEAST_BONE_HU, _LEAST_CORTEX_HU, _MOST_SOFT_HU = -150.0, 350.0, 350.0
# A CT that is not the label map's: of the labels' voxels so few are denser than 19 of 20 beside them, and in the median
# they are denser by so little, HU. Of two procedural, three real and five simulated right CTs 0.78 to 0.96 were, by 147
# to 379; with marrow of fat 0.39 to 0.83, by −3 on; of sacrum or femora alone 0.24 to 0.34, by −56 on. Of the same CTs
# turned by 180° or flipped head to foot or front to back 0.03 to 0.19 were, by −772 to 29.
_LEAST_DENSER, _LEAST_RISE_HU = 0.2, 40.0
# Cortex has more HU, and air is darker; of measured bone hardly two voxels have just the most.
_LEAST_CUT_OFF_HU, _MOST_CUT_OFF, _AIR_HU = 700.0, 0.05, -900.0
_LEAST_VOXELS = 50  # of a bone, and beside it
_MOST_VALUES = 20_000  # a quantile needs no more
_REACH_MM = 18.0  # how far a label map is looked for: a best place beyond the farthest shift that is told is none
_BRIGHT_HU = 150.0, 550.0  # from here on a voxel is bone, from there on it is no more so
_LEAST_SHIFT_MM, _MOST_SHIFT_MM = 2.5, 15.0
_LEAST_GAIN = 0.15
# Of a CT whose intercept of −1024 was applied twice: soft tissue is as dark as air is, and air darker than anything.
_DARKER_THAN_AIR_HU, _MOST_SO_DARK, _SOFT_HU, _LEAST_SOFT = -1200.0, 0.1, (-250.0, 250.0), 0.03
# Of the bone about a femoral head what lies beside all labels by two voxels and more: 0.6 % at most in 15 right label
# maps (of a network, by hand, of simulators), nearly half of it (24 ml) where a map lacked the hip bone of that side.
_ABOUT_MM, _BONE_HU = 40.0, (250.0, 1800.0)  # beyond is metal
_MOST_BARE, _MOST_BARE_ML = 0.2, 5.0
# Of the mean HU in the labels, by the shift, to that between where they lie and as far aside as is looked. Of 28 right
# CTs of three simulators none was shifted at all; labels 3 and 4 mm aside rose by 2.1 and 5.1, 2 mm aside by 0.4.
_QUICK_REACH_MM, _MOST_PLACES, _TOLD_HU, _LEAST_RISE = 6.0, 20_000, (-200.0, 800.0), 0.5
# Turns that are tried, one about each axis after the other, and shifts beside them, mm per degree. Of 67 right label
# maps of six makes none was turned at all; of two that were turned by 2.5 and 3° the mean rose by 3.1 and 1.3.
_TURN_STEPS_DEG, _SHIFT_BY_TURN, _LEAST_TURN_DEG = (3.0, 1.5, 0.75), 1.5, 1.4
_AXES = ("left to right", "front to back", "head to feet")


@dataclass(frozen=True)
class Densities:
    """What a CT holds where a label map has bone, and beside it: HU."""

    bone: float  # median
    cortex: float  # of the densest twentieth, the least
    beside: float  # median of what lies some voxels beside the bones
    denser: float  # share of the bones' voxels that are denser than 19 of 20 beside them
    most: float  # in any bone
    at_most: float  # share of the bones' voxels that have just that
    least: float  # anywhere

    @property
    def unscaled(self) -> str | None:
        """In words, that soft tissue is far too dense for HU; None where it is not."""
        if not self.beside > _MOST_SOFT_HU:
            return None
        return (
            f"CT: in the median what lies beside the bones has {self.beside:.0f} HU, and soft tissue has 50: is the "
            "rescale of the scanner applied? Export the CT in HU"
        )

    @property
    def light(self) -> str | None:
        """In words, that bones are far too light for HU, unless they are of foam; None where they are not."""
        if not (self.bone < _LEAST_BONE_HU and self.cortex < _LEAST_CORTEX_HU):
            return None
        return (
            f"CT: in the median the bones of the label map have {self.bone:.0f} HU: is the intercept of the scanner's "
            "rescale applied twice, or do CT and label map not belong to one another? Bones of foam are as light"
        )

    @property
    def windowed(self) -> str | None:
        """In words, that densest bone and air were cut off, as by a window of a display; None where they were not."""
        if not (self.most < _LEAST_CUT_OFF_HU and self.at_most > _MOST_CUT_OFF and self.least > _AIR_HU):
            return None
        return (
            f"CT: no bone has more than {self.most:.0f} HU, and {100 * self.at_most:.0f} % of their voxels have just "
            "that. It seems to be saved with a window of a display, so that cortex is lost: export it in HU"
        )

    @property
    def elsewhere(self) -> str | None:
        """In words, that a label map's bones are hardly denser than what lies beside them; None where they are."""
        if not (self.denser < _LEAST_DENSER and self.bone - self.beside < _LEAST_RISE_HU):
            return None
        return (
            f"label map: where it has bone the CT is as dense as beside it (in the median {self.bone:.0f} and "
            f"{self.beside:.0f} HU): is one of the two flipped or turned, or of another patient? Export both anew from "
            "one program, and look whether they lie on one another"
        )


def densities(ct: Volume, labels: Volume) -> Densities:
    """Densities of a CT, HU, by a label map on its grid."""
    steps = _steps(ct, _MEDIANS_MM)
    data, inside = ct.data[steps], labels.data[steps] > 0
    near, far = (_grown(inside, by) for by in (1, 3))
    bone, beside = data[inside], data[far & ~near]
    denser = float((bone > _quantile(beside, 0.95)).float().mean())
    most = float(bone.max())
    at_most = float((bone == most).float().mean())
    least = float(data.min())
    return Densities(_quantile(bone, 0.5), _quantile(bone, 0.95), _quantile(beside, 0.5), denser, most, at_most, least)


def soft_bones(ct: Volume, labels: Volume, ids: Mapping[str, int]) -> str | None:
    """In words, which bones of a label map on the grid of a CT, HU, are no denser than what lies beside them, or None.

    As of the whole map, in which the others would hide one: its id may be that of a muscle, say.
    """
    told = []
    for name, number in ids.items():
        low, high = label_box(labels, [number])
        margin = [math.ceil(4 * max(_SHIFTS_MM, s) / s) for s in labels.spacing_mm]
        shape = labels.data.shape[::-1]
        box = tuple(slice(max(a - m, 0), min(b + m, n)) for a, b, m, n in zip(low, high, margin, shape, strict=True))
        data, near = (volume.data[box[::-1]][_steps(ct, _SHIFTS_MM)] for volume in (ct, labels))
        inside = near == number
        beside = data[_grown(inside, 3) & ~_grown(inside, 1) & (near == 0)]
        if inside.sum() < _LEAST_VOXELS or len(beside) < _LEAST_VOXELS:
            continue
        bone, soft = _quantile(data[inside], 0.5), _quantile(beside, 0.5)
        denser = float((data[inside] > _quantile(beside, 0.95)).float().mean())
        if denser < _LEAST_DENSER and bone - soft < _LEAST_RISE_HU:
            told.append(f"{name} ({bone:.0f} and {soft:.0f} HU)")
    if not told:
        return None
    return (
        f"label map: {', '.join(told)}: as dense as what lies beside, in the median, so these labels hold soft tissue. "
        "Check their ids in `ct.bones`, and look whether they lie on their bones"
    )


def misplaced_labels(ct: Volume, labels: Volume, ids: Sequence[int]) -> str | None:
    """In words, that the bones of these ids would lie on the bright ones of a CT if they were shifted, or None.

    What is compared is how bright the labels' voxels are beyond what lies beside them, at all shifts of up to 18 mm.
    """
    low, high = label_box(labels, ids)
    margin = [math.ceil(_REACH_MM / s) + 2 for s in labels.spacing_mm]
    shape = labels.data.shape[::-1]
    box = tuple(slice(max(a - m, 0), min(b + m, n)) for a, b, m, n in zip(low, high, margin, shape, strict=True))[::-1]
    steps = _steps(ct, _SHIFTS_MM)
    data, inside = ct.data[box][steps], labels.data[box][steps] > 0
    bright = (data.float().clamp(*_BRIGHT_HU) - _BRIGHT_HU[0]).numpy()
    beside = _grown(inside, 1) & ~inside
    kernel = inside.float() - beside.float() * (inside.sum() / beside.sum().clamp_min(1))
    reach = [math.ceil(_REACH_MM / (s * step.step)) for s, step in zip(ct.spacing_mm[::-1], steps, strict=True)]
    scores = _correlation(bright, kernel.numpy(), reach)
    here = scores[tuple(reach)]
    apart_mm = [s * step.step for s, step in zip(ct.spacing_mm[::-1], steps, strict=True)]
    along = np.meshgrid(*(np.arange(-r, r + 1) * mm for r, mm in zip(reach, apart_mm, strict=True)), indexing="ij")
    scores[np.sqrt(sum(mm**2 for mm in along)) > _REACH_MM] = -np.inf
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    voxels = [(b - r) * step.step for b, r, step in zip(best, reach, steps, strict=True)][::-1]
    shift = ct.lps_from_index[:3, :3] @ torch.tensor(voxels, dtype=torch.float64)
    far, gained = float(shift.norm()), scores[best] > (1 + _LEAST_GAIN) * max(here, 0)
    if not (_LEAST_SHIFT_MM <= far <= _MOST_SHIFT_MM and gained):
        return None
    told = ", ".join(f"{mm + 0.0:.0f}" for mm in shift.tolist())
    return (
        f"label map: would lie on the bright bones of the CT if it were moved by ({told}) mm LPS: does it belong to "
        "this CT, and do both headers say where the first voxel lies?"
    )


def intercept_twice(ct: Volume) -> str | None:
    """In words, that a CT is too dark for HU by the intercept of its scanner; None where it is not.

    Much of it is darker than air, and hardly anything is as dense as soft tissue. What fills the corners of a CT is
    that dark too, but then there is soft tissue.
    """
    some = ct.data[_steps(ct, _MEDIANS_MM)]
    dark = float((some < _DARKER_THAN_AIR_HU).float().mean())
    soft = float(((some > _SOFT_HU[0]) & (some < _SOFT_HU[1])).float().mean())
    if dark < _MOST_SO_DARK or soft > _LEAST_SOFT:
        return None
    return (
        f"{100 * dark:.0f} % of the CT has less than {_DARKER_THAN_AIR_HU:g} HU, and air has −1000; {100 * soft:.0f} % "
        "is as dense as soft tissue: is the intercept of the scanner's rescale applied twice?"
    )


def bare_bone(ct: Volume, labels: Volume, head: Tensor) -> tuple[float, float] | None:
    """Of the bone of a CT within 40 mm of a femoral head (3,) how much a label map on its grid does not hold.

    As a share of it and in ml, where that is more than a fifth and 5 ml; otherwise None. Bone has 250 to 1800 HU, and
    what lies within two voxels of a label may be its rim.
    """
    middle = transform_points(torch.linalg.inv(ct.lps_from_index), head[None])[0]
    reach = torch.tensor([_ABOUT_MM / spacing for spacing in ct.spacing_mm])
    low, high = ((middle + sign * reach).round().int().tolist() for sign in (-1, 1))
    box = (low[0], low[1], low[2]), (high[0] + 1, high[1] + 1, high[2] + 1)
    try:
        near, inside = crop(ct, *box), crop(labels, *box)
    except InputError:  # the head lies beyond the CT
        return None
    bone = (near.data > _BONE_HU[0]) & (near.data < _BONE_HU[1])
    bare = bone & ~_grown(inside.data > 0, 2)
    share = float(bare.sum()) / max(1.0, float(bone.sum()))
    ml = float(bare.sum()) * math.prod(ct.spacing_mm) / 1000
    return (share, ml) if share > _MOST_BARE and ml > _MOST_BARE_ML else None


def shifted_labels(ct: Volume, labels: Volume) -> Tensor | None:
    """Shift (3,), mm LPS, by which a label map would lie on the bones of a CT on its grid; None where it lies there.

    Looked for axis by axis and 6 mm far, where the mean of the CT in the labels rises. `misplaced_labels` looks 18 mm
    far, on voxels of 2 mm: it takes labels that are a voxel too small, or porous bones, for shifted ones, and missed
    3 mm on one of three CTs. That is good enough for a warning, and not for a doubt.
    """
    size = torch.tensor(labels.data.shape)
    reach = (_QUICK_REACH_MM / torch.tensor(labels.spacing_mm).flip(0)).long()
    where = _some_places(labels)
    where = where[((where >= reach) & (where < size - reach)).all(1)]
    if not len(where):
        return None
    values, strides = ct.data.reshape(-1), torch.tensor([int(size[1] * size[2]), int(size[2]), 1])
    places = where @ strides

    def mean(shift: Tensor) -> float:
        return float(values[places + int(shift @ strides)].clamp(*_TOLD_HU).float().mean())

    steps = torch.eye(3, dtype=torch.long)
    best = torch.zeros(3, dtype=torch.long)
    for _ in range(2):
        for axis in range(3):
            apart = sorted(range(-int(reach[axis]), int(reach[axis]) + 1), key=abs)  # of equals, the nearest
            best = max((best * (1 - steps[axis]) + n * steps[axis] for n in apart), key=mean)
    here, found, opposite = mean(torch.zeros_like(best)), mean(best), mean(-best)
    # The marrow within too small labels is darker than the cortex on either side of them.
    if opposite > here - 0.25 * (found - here):
        return None
    aside = sum(mean(sign * reach[axis] * steps[axis]) for axis in range(3) for sign in (-1, 1)) / 6
    shift = ct.lps_from_index[:3, :3] @ best.flip(0).double()
    lies_there = float(shift.norm()) < _LEAST_SHIFT_MM or found - here < _LEAST_RISE * abs(here - aside)
    return None if lies_there else shift


def turned_labels(ct: Volume, labels: Volume) -> str | None:
    """In words, about which axis and how far a label map on the grid of a CT is turned against its bones, or None.

    The mean of the CT in the labels is looked for about turns of all axes of up to 12°, together with shifts.
    """
    where = _some_places(labels).flip(1).double()
    if not len(where):
        return None
    directions, middle = ct.lps_from_index[:3, :3], where.mean(0)
    arms, to_index = (where - middle) @ directions.T, torch.linalg.inv(directions)
    values, places = ct.data.numpy(), arms.numpy()

    def mean(motion: Tensor) -> float:
        """By a turn about the middle of the labels, degrees along LPS, and a shift, mm (6,)."""
        turn = to_index @ exp_so3(torch.deg2rad(motion[:3]))
        return _mean_at(values, places, turn.numpy(), (middle + to_index @ motion[3:]).numpy(), *_TOLD_HU)

    units = torch.eye(6, dtype=torch.float64)
    best = torch.zeros(6, dtype=torch.float64)
    here = found = mean(best)
    for step in _TURN_STEPS_DEG:
        for way in [*units, *units]:
            apart = way * torch.where(way.argmax() < 3, step, _SHIFT_BY_TURN * step)
            tried = [best + n * apart for n in (-1, 1, -2, 2)]
            found, best = max([(found, best), *((mean(each), each) for each in tried)], key=itemgetter(0))
    turn = best[:3]
    aside = sum(mean(sign * _QUICK_REACH_MM * way) for way in units[3:] for sign in (-1, 1)) / 6
    lies_there = float(turn.norm()) < _LEAST_TURN_DEG or found - here < _LEAST_RISE * abs(here - aside)
    if lies_there or mean(-best) > here - 0.25 * (found - here):  # the latter of too small labels, as above
        return None
    return (
        f"label map: would lie on the bones of the CT if it were turned by {float(turn.norm()):.0f}° about the axis "
        f"from {_AXES[int(turn.abs().argmax())]}: does it belong to this CT, and do both headers tell the same "
        "directions of rows, columns and slices?"
    )


def _some_places(labels: Volume) -> Tensor:
    """Indices (N, 3) along z, y and x of voxels that a label map names, evenly chosen where there are many."""
    named = np.flatnonzero(labels.data.numpy())
    some = named[:: 1 + len(named) // _MOST_PLACES]
    return torch.from_numpy(np.stack(np.unravel_index(some, tuple(labels.data.shape)), 1))


@numba.njit(cache=True, nogil=True)
def _mean_at(
    values: np.ndarray, arms: np.ndarray, turn: np.ndarray, middle: np.ndarray, least: float, most: float
) -> float:  # pragma: no cover (compiled)
    """Of the voxels next to `turn` (3, 3) times `arms` (N, 3) plus `middle` (3,), indices along x, y and z."""
    size, total = values.shape[::-1], 0.0
    index = np.zeros(3, np.int64)
    for x, y, z in arms:
        for n in range(3):
            place = np.rint(middle[n] + turn[n, 0] * x + turn[n, 1] * y + turn[n, 2] * z)
            index[n] = min(max(int(place), 0), size[n] - 1)
        total += min(max(float(values[index[2], index[1], index[0]]), least), most)
    return total / len(arms)


def _steps(volume: Volume, apart_mm: float) -> tuple[slice, slice, slice]:
    """Every n-th voxel along z, y and x, so that they are about as far apart."""
    x, y, z = (slice(None, None, max(1, round(apart_mm / s))) for s in volume.spacing_mm)
    return z, y, x


def _quantile(values: Tensor, share: float) -> float:
    """Of some of the values (N,); nan of none."""
    return float(values[:: 1 + len(values) // _MOST_VALUES].float().quantile(share)) if len(values) else math.nan


def _grown(mask: Tensor, by: int) -> Tensor:
    """A mask (D, H, W), bool, grown by some voxels along all axes."""
    for axis, size in enumerate(mask.shape):
        grown = mask.clone()
        for n in range(1, min(by, size - 1) + 1):
            grown.narrow(axis, n, size - n).logical_or_(mask.narrow(axis, 0, size - n))
            grown.narrow(axis, 0, size - n).logical_or_(mask.narrow(axis, n, size - n))
        mask = grown
    return mask


def _correlation(image: np.ndarray, kernel: np.ndarray, reach: Sequence[int]) -> np.ndarray:
    """Σ image(x + shift) kernel(x), for all shifts of up to `reach` voxels along each axis, (2 r + 1, …)."""
    shape = [fft.next_fast_len(n + r, real=True) for n, r in zip(image.shape, reach, strict=True)]
    product = fft.rfftn(image, shape) * np.conj(fft.rfftn(kernel, shape))
    found = fft.irfftn(product, shape)
    for axis, r in enumerate(reach):
        found = np.take(found, range(-r, r + 1), axis, mode="wrap")
    return np.asarray(found)
