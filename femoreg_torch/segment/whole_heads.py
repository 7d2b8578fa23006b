"""Femoral heads made whole: where a sphere of cortex is seen in the CT, all within it is femur.

In old bone the marrow of a head is fatty: between its dense middle and the thin cortex it is as dark as soft tissue.
There a network that follows brightness cuts the head down to its middle, and takes parts of its cortex for the socket.
But the cortex is nearly a sphere. It is looked for by votes, then followed along rays: first where no socket lies
behind it, as there are two sheets of bone elsewhere, then everywhere. Where the cortex lies within the sphere, as in a
flattened head, so does the femur.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.segment.boxes import Mask, width
from femoreg_torch.segment.sphere import fitted_sphere
from femoreg_torch.segment.sphere_votes import (
    COARSE_MM,
    RADII_MM,
    RIDGE_RANGE_HU,
    Points,
    along_rays,
    directions,
    sphere_votes,
)

SOFT_HU, METAL_HU = 50.0, 2300.0  # of soft tissue, and from which on something is metal
_AT_JOINT_MM = 15.0  # of the hip bone: femur that is nearer is head, and some of the neck
_LEAST_ML = 2.0  # of it
_AROUND_MM = 45.0  # to either side of its middle, where the sphere is looked for
_FROM_MIDDLE_MM = 20.0  # at which the sphere's centre may lie
_CANDIDATES, _PEAK_VOXELS = 5, 5  # metal in a head has votes too
_BLUR_MM, _STEP_MM, _RAYS = 0.7, 0.5, 600
_SHEET_MM = 2.5  # to either side of a sheet, where it is darker: a joint space is as wide
_SHEET_HU = 12.0  # by which it is brighter there than on the mean of both sides
_FIRST_MM, _LAST_MM, _NARROWER_MM = 4.0, 1.5, 0.4  # from the sphere, where sheets are looked for, round by round
_PREFERRED_MM = 3.0  # sheets count less, the farther they are
_ROUNDS, _ROUNDS_FREE = 12, 8  # the first ones where neither neck nor socket lies behind
_FEWEST_FREE = 0.12  # of all rays
_NECK_MM, _NECK_SHARE = (4.0, 11.0), 0.4  # beyond the sphere, and how much of that is femur
_SOCKET_MM = (-2.0, 13.0)  # beyond the sphere, where any hip bone is its socket
_MOST_A_ROUND_MM = 8.0  # that the centre moves; else it runs away
# Of rays but for the neck's, on which the strongest sheet is on the sphere. On four heads of three real CTs, one with a
# screw within: 0.66 to 0.72; on other spheres near them 0.58 at most. On six of simulated CTs: 0.98 to 1.00.
_LEAST_SEEN = 0.6
_LEAST_FEMUR = 0.4  # of the ball, by the labels: 0.55 to 0.63 on those four
_MOST_METAL = 0.25  # of the ball; a prosthesis has a head of its own
_BESIDE = 0.4  # rays whose ends on the unit sphere are so near (23°): the cortex is taken at their median
_CORTEX_MM = 0.5  # from the middle of the cortex to its outside
_JOINT_MM = 3.0  # the socket is farther, but for its cortex; that is brighter than half of the brightest so near


@dataclass(frozen=True, eq=False)
class _Around:
    """What lies around the head of a femur, on voxels of 1 mm (within one per cent, as whole ones fill a box)."""

    hu: NDArray[np.float32]  # (Z, Y, X)
    femur: NDArray[np.float32]
    hip: NDArray[np.float32]
    first: NDArray[np.intp]  # z, y, x of the first voxel, in the region's
    size_mm: Points  # (3,) of its voxels

    def place(self, point: Points, step: Points) -> Points:
        """The place in mm from the middle of the region's first voxel, z, y, x, of a point (3,) in voxels."""
        return (self.first - 0.5) * step + (point + 0.5) * self.size_mm


@dataclass(frozen=True, eq=False)
class _Head:
    """A head as rays from its centre see it."""

    sphere: Points  # (4,) centre (z, y, x in mm, which are voxels) and radius
    ways: Points  # (rays, 3)
    cortex: Points  # (rays,) mm from the centre

    def reach(self, apart: Points) -> Points:
        """How far it reaches (...), mm, towards places (..., 3) that lie `apart` from its centre."""
        found: Points = self.cortex[
            cKDTree(self.ways).query(apart / np.linalg.norm(apart, axis=-1, keepdims=True).clip(1e-6))[1]
        ]
        return found + _CORTEX_MM


def whole_heads(
    labels: NDArray[np.uint8], hu: NDArray[np.float32], spacing: NDArray[np.float64], anatomy: Anatomy
) -> NDArray[np.uint8]:
    """The labels (Z, Y, X) with femoral heads filled to the sphere that the CT shows; `spacing` (3,) along x, y, z."""
    result, step = labels.copy(), spacing[::-1]
    for side in ("left", "right"):
        femur, hip = (1 + anatomy.bone_names.index(f"{bone}_{side}") for bone in ("femur", "hip"))
        around = _around_the_head(labels == femur, labels == hip, hu, step)
        head = None if around is None else _head_of(around)
        if around is None or head is None:
            continue
        centre = around.place(head.sphere[:3], step)
        room = float(head.sphere[3]) + _CORTEX_MM + 2 * _JOINT_MM
        box = tuple(
            slice(max(0, int((c - room) / s)), min(n, max(0, int((c + room) / s) + 2)))
            for c, s, n in zip(centre, step, labels.shape, strict=True)
        )
        here, bright = labels[box], hu[box]
        first = np.array([part.start for part in box])
        apart = (_voxels(here.shape) + first) * step - centre
        beyond = np.linalg.norm(apart, axis=-1) - head.reach(apart)
        ball = beyond < 0
        if (here[ball] == femur).mean() < _LEAST_FEMUR or (bright[ball] > METAL_HU).mean() > _MOST_METAL:
            continue
        half = (ndimage.maximum_filter(bright.clip(max=METAL_HU), width(_JOINT_MM, spacing)) + SOFT_HU) / 2
        result[box][(here == hip) & (beyond < _JOINT_MM) & (bright < half)] = 0
        result[box][ball & ((here == 0) | (here == hip))] = femur
    return result


def _around_the_head(femur: Mask, hip: Mask, hu: NDArray[np.float32], step: Points) -> _Around | None:
    """The surroundings of the end of a femur that is next to its hip bone; None where there is no such end."""
    if not femur.any() or not hip.any():
        return None
    [both] = ndimage.find_objects((femur | hip).astype(np.uint8))
    near = ndimage.distance_transform_edt(~hip[both], sampling=step) < _AT_JOINT_MM
    end = np.argwhere(femur[both] & near)
    if len(end) * float(np.prod(step)) < 1000 * _LEAST_ML:
        return None
    middle = np.median(end, 0) + [part.start for part in both]
    first = np.maximum(0, np.floor(middle - _AROUND_MM / step)).astype(int)
    last = np.minimum(hu.shape, np.ceil(middle + _AROUND_MM / step)).astype(int)
    box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))

    def cubic(values: NDArray[np.generic]) -> NDArray[np.float32]:
        found: NDArray[np.float32] = ndimage.zoom(
            values[box].astype(np.float32), step, order=1, mode="nearest", grid_mode=True
        )
        return found

    near_hu = cubic(hu).clip(*RIDGE_RANGE_HU)
    return _Around(near_hu, cubic(femur), cubic(hip), first, (last - first) * step / near_hu.shape)


def _head_of(around: _Around) -> _Head | None:
    """The head whose cortex lies on a sphere; None without one."""
    smooth = ndimage.gaussian_filter(around.hu, _BLUR_MM)
    ways = directions(_RAYS)
    found = [_followed(around, smooth, sphere, ways) for sphere in _voted_spheres(around)]
    if not found:
        return None
    sphere, share = max(found, key=lambda one: one[1])
    if share < _LEAST_SEEN:
        return None
    at, seen = _sheets(smooth, sphere, _FIRST_MM, ways)
    cortex = np.full(_RAYS, sphere[3])
    for ray, beside in enumerate(cKDTree(ways).query_ball_point(ways, _BESIDE)):
        if seen[beside].any():
            cortex[ray] = min(sphere[3], np.median(at[beside][seen[beside]]))
    return _Head(sphere, ways, cortex)


def _followed(around: _Around, smooth: NDArray[np.float32], sphere: Points, ways: Points) -> tuple[Points, float]:
    """The sphere (4,) through the sheets along rays, from one near it; and on what share of rays one is on it."""
    nothing = sphere, 0.0
    for number in range(_ROUNDS):
        within = max(_LAST_MM, _FIRST_MM - number * _NARROWER_MM)
        at, seen = _sheets(smooth, sphere, within, ways)
        neck, socket = _behind(around, sphere, ways)
        free = seen & ~neck & ~socket
        used = free if number < _ROUNDS_FREE and free.mean() >= _FEWEST_FREE else seen & ~neck
        if used.mean() < _FEWEST_FREE:
            return nothing
        before, sphere = sphere, fitted_sphere(sphere[:3] + ways[used] * at[used, None])
        moved = np.linalg.norm(sphere[:3] - before[:3])
        if not (moved < _MOST_A_ROUND_MM and RADII_MM[0] - 1 < sphere[3] < RADII_MM[-1] + 1):
            return nothing
    at, seen = _sheets(smooth, sphere, _FIRST_MM, ways)
    neck, _ = _behind(around, sphere, ways)
    on_it = seen & (np.abs(at - sphere[3]) <= _LAST_MM) & ~neck
    return sphere, float(on_it.sum() / max(1, (~neck).sum()))


def _voted_spheres(around: _Around) -> list[Points]:
    """Centres and radii (4,) that most sheets vote for, near the middle of what is looked at."""
    coarse = ndimage.zoom(around.hu, 1 / COARSE_MM, order=1, mode="nearest", grid_mode=True)
    votes, radii = sphere_votes(coarse)
    places = (_voxels(votes.shape) + 0.5) * COARSE_MM - 0.5
    near = np.linalg.norm(places - np.array(around.hu.shape) / 2, axis=-1) < _FROM_MIDDLE_MM
    peaks = np.argwhere(near & (votes == ndimage.maximum_filter(votes, _PEAK_VOXELS)))
    peaks = peaks[np.argsort(-votes[tuple(peaks.T)])][:_CANDIDATES]
    return [np.r_[places[tuple(peak)], float(radii[tuple(peak)])] for peak in peaks]


def _voxels(shape: tuple[int, ...]) -> Points:
    """The indices (Z, Y, X, 3) of all voxels."""
    return np.moveaxis(np.indices(shape).astype(float), 0, -1)


def _sheets(smooth: NDArray[np.float32], sphere: Points, within: float, ways: Points) -> tuple[Points, Mask]:
    """Where on each ray (rays,) a sheet is within so many mm of the sphere, mm from its centre; and whether one is."""
    aside = round(_SHEET_MM / _STEP_MM)
    steps = np.arange(-within - _SHEET_MM, within + _SHEET_MM + _STEP_MM / 2, _STEP_MM)
    values = along_rays(smooth, sphere[:3], ways, sphere[3] + steps)
    higher = values[:, aside:-aside] - (values[:, : -2 * aside] + values[:, 2 * aside :]) / 2
    off = steps[aside:-aside]
    best = (higher * np.exp(-0.5 * (off / _PREFERRED_MM) ** 2)).argmax(1)
    return sphere[3] + off[best], higher[np.arange(len(ways)), best] > _SHEET_HU


def _behind(around: _Around, sphere: Points, ways: Points) -> tuple[Mask, Mask]:
    """On which rays (rays,) the neck, and on which the socket lies behind the sphere."""
    beyond = along_rays(around.femur, sphere[:3], ways, sphere[3] + np.arange(*_NECK_MM))
    socket = along_rays(around.hip, sphere[:3], ways, sphere[3] + np.arange(*_SOCKET_MM))
    return beyond.mean(1) > _NECK_SHARE, socket.max(1) > 0.5
