"""Which shadow is which bead, without labels, and the pose that follows from it in one image.

Three beads on three shadows give up to four poses (P3P). Every such guess is scored by how many other beads then fall
on a shadow (MSAC: Torr and Zisserman, CVIU 78 (2000) 138), the best few are fitted to all shadows that they explain,
and the assignment is made anew, one to one, with a narrow limit. A rough pose narrows the guesses to shadows near the
places that it predicts; it has no other part in the result. A match counts only if chance hardly makes one as good
among as many guesses: the a-contrario bound of Moisan and Stival, Int J Comput Vis 57 (2004) 201. The paper says
nothing of this step: there people said which shadow is which bead.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from femoreg_torch.beads.model import MINIMUM
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera
from femoreg_torch.pnp import refined_pose, three_point_poses

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_SHADOW_MM = 0.1  # deviation of a measured shadow on the detector: half a pixel
_MAGNIFIED = 1.6  # a bead's own error on the detector: beads lie at about 0.62 of the distance
_NARROW = 3.0  # deviations by which a bead may miss its shadow by a pose fitted to all
_WIDE = 3.0  # times as far by a pose from three others, whose errors it carries along
_DEPTHS = (0.2, 1.0)  # of the source-to-detector distance: beads lie between source and detector
_GUESSES = 150_000  # at most: some four seconds
_REFINED = 12  # best guesses that are fitted
_CHANCE = 0.05  # matches as good that chance may be expected to make: a level of 5 %
_ALIKE = 3.0  # a rival with as many beads must fit worse by this factor
_FLOOR_PX = 0.3  # of residuals that are compared


@dataclass(frozen=True, eq=False)
class Match:
    """Shadows assigned to beads in one image, and the pose that they agree on."""

    camera_from_object: Tensor  # (4, 4) float64
    spots: Tensor  # (N,) index of each bead's shadow, −1 without one
    rms_px: float  # reprojection residual of the matched beads

    @property
    def count(self) -> int:
        """Matched beads."""
        return int((self.spots >= 0).sum())


def match_beads(
    points: Tensor,
    spots: Tensor,
    camera: Camera,
    rough: Tensor | None = None,
    gate_mm: float = 30.0,
    deviation_mm: float = 0.0,
    labels: Tensor | None = None,
    where: str = "beads",
) -> Match:
    """Match beads (N, 3), mm in their object, with shadows (M, 2) (column, row), of which some may be of other things.

    Some beads may lack a shadow, but four must have one. `rough` is a `camera_from_object` (4, 4) by which every bead
    falls within `gate_mm`, on the detector, of its shadow; None: anywhere between source and detector. `deviation_mm`
    is that of the beads' own places; `labels` (M,) says which bead a shadow is, −1 where nobody knows. The result does
    not depend on chance. Raises `InputError` that starts with `where` if no match stands out from chance, or two
    different ones explain as much.
    """
    if len(spots) < MINIMUM:
        raise InputError(
            f"{where}: {len(spots)} shadows of beads found, at least {MINIMUM} are needed. Annotate them by hand "
            "(`annotations`), or check the beads' diameter."
        )
    beads, seen = points.double().numpy(), spots.double().numpy()
    narrow_mm = _NARROW * float(np.hypot(_SHADOW_MM, _MAGNIFIED * deviation_mm))
    limit_px = narrow_mm / camera.mean_pixel_mm
    allowed = _allowed(beads, seen, camera, rough, gate_mm)
    if labels is not None:
        told = labels.numpy()
        allowed &= (told < 0) | (told == np.arange(len(beads))[:, None])
    tried = 0
    best: list[tuple[float, Array]] = []
    for guess, number in _guesses(beads, seen, camera, allowed, _WIDE * narrow_mm):
        tried += number
        best = sorted([*best, *_scored(guess, beads, seen, camera, allowed, _WIDE * limit_px)], key=lambda g: g[0])[
            :_REFINED
        ]
        if tried > _GUESSES or (best and best[0][0] < _all_found(len(beads))):
            break
    found: dict[tuple[int, ...], Match] = {}
    for _, pose in best:
        if (match := _fitted(pose, beads, seen, camera, allowed, limit_px)) is not None:
            found.setdefault(tuple(match.spots.tolist()), match)
    ranked = sorted(found.values(), key=lambda m: (-m.count, m.rms_px))
    if not ranked or ranked[0].count < MINIMUM:
        reached = ranked[0].count if ranked else 0
        raise InputError(
            f"{where}: no pose brings at least {MINIMUM} of the {len(beads)} beads onto the {len(seen)} shadows (the "
            f"best {reached}). Annotate the shadows by hand, or give a rough pose (--run)."
        )
    chance = _expected(
        seen * camera.mean_pixel_mm, allowed, ranked[0].count, tried, None if rough is None else gate_mm, narrow_mm
    )
    if chance > _CHANCE:
        raise InputError(
            f"{where}: {ranked[0].count} of {len(beads)} beads match, which chance alone does too (expected "
            f"{chance:.2g} times among so many shadows). Annotate the shadows by hand, or give a rough pose (--run)."
        )
    _refuse_rivals(ranked, where)
    return ranked[0]


def _all_found(count: int) -> float:
    """Score of a guess that puts all beads close to shadows: a tenth of what one lost bead costs."""
    return 0.1 * count / max(count - 3, 1)


def _allowed(beads: Array, seen: Array, camera: Camera, rough: Tensor | None, gate_mm: float) -> NDArray[np.bool_]:
    """Which shadow (M) may be of which bead (N), (N, M)."""
    if rough is None:
        return np.ones((len(beads), len(seen)), bool)
    distances = np.linalg.norm(_projected(rough.double().numpy()[None], beads, camera)[0][:, None] - seen, axis=2)
    return np.asarray(distances * camera.mean_pixel_mm <= gate_mm)


def _projected(poses: Array, beads: Array, camera: Camera) -> Array:
    """Pixels (B, N, 2) of beads (N, 3) at poses (B, 4, 4); far off where a bead is not between source and detector."""
    places = beads @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    depth = places[..., 2]
    between = (depth > _DEPTHS[0] * camera.sdd_mm) & (depth < _DEPTHS[1] * camera.sdd_mm)
    projected = places @ camera.matrix().numpy().T
    pixels = projected[..., :2] / np.where(between, depth, 1.0)[..., None]
    return np.where(between[..., None], pixels, 1e9)


def _guesses(
    beads: Array, seen: Array, camera: Camera, allowed: NDArray[np.bool_], wide_mm: float
) -> Iterator[tuple[Array, int]]:
    """Poses (B, 4, 4) from three beads on three shadows, and how many triples of shadows were tried.

    Triples of beads come by the area of their triangle, the widest first, as they fix the pose best.
    """
    matrix = camera.matrix().numpy()
    apart = np.linalg.norm(seen[:, None] - seen, axis=2) * camera.mean_pixel_mm
    largest = 1 / _DEPTHS[0]

    def area(triple: tuple[int, ...]) -> float:
        a, b, c = beads[list(triple)]
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    for triple in sorted(combinations(range(len(beads)), 3), key=area, reverse=True):
        if area(triple) == 0:
            return
        i, j, k = triple
        sides = [largest * np.linalg.norm(beads[a] - beads[b]) + wide_mm for a, b in ((i, j), (i, k), (j, k))]
        poses: list[Array] = []
        number = 0
        for p in np.flatnonzero(allowed[i]):
            for q in np.flatnonzero(allowed[j] & (apart[p] <= sides[0])):
                if q == p:
                    continue
                for r in np.flatnonzero(allowed[k] & (apart[p] <= sides[1]) & (apart[q] <= sides[2])):
                    if r not in (p, q):
                        number += 1
                        poses += three_point_poses(beads[[i, j, k]], seen[[p, q, r]], matrix)
            if number > _GUESSES:
                break
        if poses:
            yield np.array(poses), number


def _scored(
    poses: Array, beads: Array, seen: Array, camera: Camera, allowed: NDArray[np.bool_], limit_px: float
) -> list[tuple[float, Array]]:
    """The best poses with their truncated squared residuals, in units of a lost bead."""
    costs = np.empty(len(poses))
    for start in range(0, len(poses), 4096):
        part = slice(start, start + 4096)
        squared = ((_projected(poses[part], beads, camera)[:, :, None] - seen) ** 2).sum(3)
        nearest = np.where(allowed, squared, np.inf).min(2)
        costs[part] = np.minimum(nearest / limit_px**2, 1).sum(1)
    order = np.argsort(costs, kind="stable")[:_REFINED]
    return [(float(costs[n]), poses[n]) for n in order]


def _fitted(
    pose: Array, beads: Array, seen: Array, camera: Camera, allowed: NDArray[np.bool_], limit_px: float
) -> Match | None:
    """The match near a pose from three beads; None if fewer than four beads take part."""
    matrix = camera.matrix().numpy()
    for times in (_WIDE, 2.0, 1.0, 1.0):
        pairs = _assigned(_projected(pose[None], beads, camera)[0], seen, times * limit_px, allowed)
        used = pairs >= 0
        if used.sum() < MINIMUM:
            return None
        pose = refined_pose(pose, beads[used], seen[pairs[used]], matrix)
    residuals = _projected(pose[None], beads, camera)[0][used] - seen[pairs[used]]
    rms = float(np.sqrt((residuals**2).sum(1).mean()))
    return Match(torch.from_numpy(pose), torch.from_numpy(pairs), rms)


def _assigned(projected: Array, seen: Array, limit_px: float, allowed: NDArray[np.bool_]) -> Ints:
    """The shadow (N,) of every bead, −1 for none, of least total distance (Hungarian method), one to one."""
    distances = np.where(allowed, np.linalg.norm(projected[:, None] - seen, axis=2), np.inf)
    costs = np.concatenate([np.minimum(distances, 1e6), np.full((len(projected), len(projected)), limit_px)], 1)
    rows, columns = linear_sum_assignment(costs)
    pairs = np.full(len(projected), -1)
    close = (columns < len(seen)) & (costs[rows, columns] <= limit_px)
    pairs[rows[close]] = columns[close]
    return pairs


def _expected(
    seen_mm: Array, allowed: NDArray[np.bool_], matched: int, tried: int, gate_mm: float | None, limit_mm: float
) -> float:
    """How many matches of as many beads chance makes: guesses times the binomial tail of the beads beyond three.

    A shadow by chance lies anywhere in the gate, or, without a rough pose, in the box around all shadows. Where the
    gate leaves no choice, the rough pose has labelled the shadows, and chance has no part: 0.
    """
    if allowed.sum(1).max() <= 1 and allowed.sum(0).max() <= 1:
        return 0.0
    area = float(np.prod(np.ptp(seen_mm, axis=0))) if gate_mm is None else np.pi * gate_mm**2
    share = min(1.0, float(allowed.sum(1).mean() * np.pi * limit_mm**2 / max(area, 1e-9)))
    rest = len(allowed) - 3
    return tried * sum(comb(rest, n) * share**n * (1 - share) ** (rest - n) for n in range(matched - 3, rest + 1))


def _refuse_rivals(ranked: list[Match], where: str) -> None:
    """Raises `InputError` if another assignment of as many beads fits about as well."""
    best = ranked[0]
    for rival in ranked[1:]:
        as_good = max(rival.rms_px, _FLOOR_PX) < _ALIKE * max(best.rms_px, _FLOOR_PX)
        if rival.count == best.count and as_good:
            raise InputError(
                f"{where}: two ways to match {best.count} beads fit about as well ({best.rms_px:.2f} and "
                f"{rival.rms_px:.2f} px). Annotate the shadows by hand, with the names of the beads."
            )
