"""Beads in a CT: small round spots brighter than bone, their centres measured to a fraction of a voxel.

A bead of 1 mm is about as large as a voxel, so what the CT shows is its blur, nearly a Gaussian. Its share in every
voxel within some millimetres is fitted, over a plane for the bone around: the centre follows from partial volumes.
Voxels that the scanner has clipped are left out. What is taken for a bead is fitted again over a cubic surface, where
the window has voxels enough for its twenty terms: a cortex beside a bead moved its centre by up to 0.18 mm over a
plane, by 0.08 mm over a cubic (86 beads in a simulated femur, rms along each axis 0.022 and 0.011 mm). How far a centre
may be off is told by what the fit leaves. The paper labelled its beads in the CT by hand (section III-B).
"""

from itertools import combinations_with_replacement

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, special
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume import Volume

Array = NDArray[np.float64]

_ABOVE_HU = 700.0  # over the tissue around: trabecular bone stays 300 below its neighbours, cortical bone is no spot
_AROUND_MM = 7.0  # edge of the box whose mean is the tissue around
_WINDOW_MM = 2.5  # of the fit beyond the bead's radius
_BLUR_MM = (0.15, 1.1)  # standard deviation of the scanner: sharper than any, a soft kernel
_OBLONG = 1.7  # most by which a bead is longer than wide, of its blurred deviations
_EXPLAINED = 0.80  # least share of the variance in the window that the fit explains
_CANDIDATES = 100  # that are fitted, those that stand out most first
_RIVAL = 0.5  # of the faintest bead: what comes as close to it makes the count doubtful
_STEPS = 30  # of a fit
_VOXELS_A_TERM = 2  # at least, of a cubic surface
_WIDER = 1.2  # by which centres are further off than the fit's residuals tell: these are bone, and correlated
_LEAST_MM = 0.01  # deviation of a centre
_SPREAD_MM = 1.6  # by which blur widens a bead on each side, where it is half as bright as a clipped middle
_CLIPPED = 3  # voxels at the largest value, from which on that is where the scanner clips


def find_beads(
    ct: Volume, diameter_mm: float, count: int, within: Tensor | None, where: str = "CT"
) -> tuple[Tensor, Tensor]:
    """Centres (count, 3) of metal beads in a CT in HU, mm in its space, ordered from head to foot.

    Also their standard deviations (count,) along each axis, mm, by first order from the fit's residuals.

    Only voxels `within` (Z, Y, X), bool, are searched (None: all). Raises `InputError` that starts with `where` if
    there are fewer beads, or more things that look like one.
    """
    if not 0.3 <= diameter_mm <= 6:
        raise InputError(f"{where}: beads of {diameter_mm:g} mm were asked for, 0.3 to 6 mm were expected.")
    spacing = np.array(ct.spacing_mm)
    if spacing.max() > 2 * max(diameter_mm, 0.75):
        raise InputError(
            f"{where}: voxels of up to {spacing.max():.2g} mm are too coarse for beads of {diameter_mm:g} mm. Give the "
            "points by hand."
        )
    data = ct.data.numpy()
    low, high = _box(within, data.shape)
    part = data[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].astype(np.float32)
    around = ndimage.uniform_filter(part, [max(3, round(_AROUND_MM / s) // 2 * 2 + 1) for s in spacing[::-1]])
    stands_out = part - around
    peaks = (stands_out > _ABOVE_HU) & (part == ndimage.maximum_filter(part, 3))
    if within is not None:
        peaks &= within.numpy()[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    plateaus, number = ndimage.label(peaks, np.ones((3, 3, 3)))  # a clipped bead has many voxels as bright
    numbers = np.arange(1, number + 1)
    index = np.round(np.array(ndimage.center_of_mass(peaks, plateaus, numbers)).reshape(-1, 3)).astype(int)
    contrasts = np.asarray(ndimage.maximum(stands_out, plateaus, numbers))
    best = np.argsort(-contrasts, kind="stable")[:_CANDIDATES]
    index, contrasts = index[best] + low, contrasts[best]
    largest = float(part.max())
    clip = largest if (part >= largest).sum() >= _CLIPPED else np.inf
    found: list[Array] = []  # (x, y, z index, mass, deviation)
    faintest = np.inf
    for (z, y, x), contrast in zip(index, contrasts, strict=True):
        if len(found) >= count and contrast < _RIVAL * faintest:
            break  # nothing that follows can be taken for a bead
        spot = _fitted(data, np.array([x, y, z]), spacing, diameter_mm, clip)
        if spot is not None and all(np.linalg.norm((spot[:3] - o[:3]) * spacing) > diameter_mm for o in found):
            found.append(spot)
            faintest = min(faintest, contrast)
    found.sort(key=lambda spot: -spot[3])
    if len(found) < count:
        raise InputError(
            f"{where}: {len(found)} beads of {diameter_mm:g} mm found, {count} were expected. Check their diameter and "
            "the label map, or give the points by hand."
        )
    if len(found) > count and found[count][3] > _RIVAL * found[count - 1][3]:
        alike = sum(spot[3] > _RIVAL * found[count - 1][3] for spot in found)
        raise InputError(
            f"{where}: {alike} spots look like beads of {diameter_mm:g} mm, {count} were expected. Check `count`, or "
            "give the points by hand."
        )
    fits = [_fitted(data, np.round(spot[:3]).astype(int), spacing, diameter_mm, clip, 3) for spot in found[:count]]
    table = np.array([spot if fit is None else fit for spot, fit in zip(found, fits, strict=False)])
    centres = transform_points(ct.lps_from_index, torch.from_numpy(table[:, :3]))
    order = torch.argsort(-centres[:, 2])
    return centres[order], torch.from_numpy(table[:, 4])[order]


def _box(within: Tensor | None, shape: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """First and last + 1 index [z, y, x] of what is to be searched."""
    if within is None:
        return [0, 0, 0], list(shape)
    axes = [within.any(dim=(1, 2)), within.any(dim=(0, 2)), within.any(dim=(0, 1))]
    spans = [axis.nonzero()[:, 0] for axis in axes]
    if any(len(span) == 0 for span in spans):
        raise InputError("beads: no voxel of the label map belongs to the object.")
    return [int(span[0]) for span in spans], [int(span[-1]) + 1 for span in spans]


def _fitted(
    data: NDArray[np.floating], start: Array, spacing: Array, diameter_mm: float, clip: float, degree: int = 1
) -> Array | None:
    """(x, y, z) index, mass (HU · mm³), deviation (mm) of a round spot near a voxel (x, y, z); None if there is none.

    The bone around is a polynomial of the `degree` in x, y, z.
    """
    reach = diameter_mm / 2 + _WINDOW_MM
    half = np.ceil(reach / spacing).astype(int)
    low, high = start - half, start + half + 1
    if (low < 0).any() or (high > np.array(data.shape[::-1])).any():
        return None
    part = data[low[2] : high[2], low[1] : high[1], low[0] : high[0]].astype(np.float64)
    z, y, x = np.mgrid[-half[2] : half[2] + 1, -half[1] : half[1] + 1, -half[0] : half[0] + 1]
    places = np.stack([x, y, z], -1) * spacing  # mm from the voxel
    chosen = (np.linalg.norm(places, axis=-1) <= reach) & (part < clip)
    if not _small(part, places, diameter_mm):
        return None
    places, values = places[chosen], part[chosen]
    if len(values) < 20:
        return None
    around = _polynomial(places / reach, degree)
    if len(values) < _VOXELS_A_TERM * around.shape[1] and degree > 1:
        return None

    def solved(parameters: Array) -> tuple[Array, float]:
        sizes = parameters[[3, 3, 4]] * np.sqrt(2)  # a scanner blurs alike along x and y
        rim = [special.erf((places - parameters[:3] + side * spacing / 2) / sizes) for side in (1, -1)]
        bead = np.prod((rim[0] - rim[1]) / 2, axis=1)  # share of the blurred bead in each voxel
        terms = np.column_stack([bead, around])
        linear = np.linalg.lstsq(terms, values, rcond=None)[0]
        return values - terms @ linear, float(linear[0])

    ball = diameter_mm / 2 / np.sqrt(5)  # deviation of a full sphere along an axis
    lowest, highest = (float(np.hypot(ball, blur)) for blur in _BLUR_MM)
    first = np.array([0.0, 0, 0, *np.hypot(ball, np.array([0.5, 0.5]))])
    edge = float(spacing.max()) + diameter_mm / 2
    bounds = ([-edge] * 3 + [lowest] * 2, [edge] * 3 + [highest] * 2)
    fit = least_squares(
        lambda p: solved(p)[0], first.clip(*bounds), bounds=bounds, x_scale=0.1, xtol=1e-5, max_nfev=_STEPS
    )
    residuals, share = solved(fit.x)
    free = max(len(values) - around.shape[1] - 1 - len(fit.x), 1)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * float(residuals @ residuals) / free
    deviation = max(_LEAST_MM, _WIDER * float(np.sqrt(covariance.diagonal()[:3].mean())))
    sizes = fit.x[3:]
    explained = 1 - float((residuals**2).sum()) / max(float(((values - values.mean()) ** 2).sum()), 1e-9)
    if (
        share * _largest_share(sizes, spacing) < _ABOVE_HU
        or explained < _EXPLAINED
        or sizes.max() > _OBLONG * sizes.min()
        or sizes.max() > 0.98 * highest
    ):
        return None
    mass = share * float(np.prod(spacing))
    return np.array([*(start + fit.x[:3] / spacing), mass, deviation])


def _polynomial(places: Array, degree: int) -> Array:
    """All products of up to `degree` coordinates (N, terms) at places (N, 3)."""
    axes = [axes for power in range(degree + 1) for axes in combinations_with_replacement(range(3), power)]
    return np.stack([places[:, list(chosen)].prod(1) for chosen in axes], 1)


def _largest_share(sizes: Array, spacing: Array) -> float:
    """Share of a blurred bead that a voxel about its centre holds."""
    return float(np.prod(special.erf(spacing / 2 / (sizes[[0, 0, 1]] * np.sqrt(2)))))


def _small(part: Array, places: Array, diameter_mm: float) -> bool:
    """Whether what is more than half as bright as the middle takes no more room than a bead; `part` is its window."""
    distance = np.linalg.norm(places, axis=-1)
    level = float(np.median(part[distance > distance.max() - 1.0 - diameter_mm / 2]))
    height = float(part[distance <= diameter_mm].max()) - level
    voxel = float(np.prod([places[1, 1, 1, n] - places[0, 0, 0, n] for n in range(3)]))
    room = np.pi / 6 * (diameter_mm + 2 * _SPREAD_MM) ** 3
    inside = distance <= diameter_mm / 2 + _WINDOW_MM
    return height > _ABOVE_HU and float((part[inside] > level + height / 2).sum()) * voxel <= room
