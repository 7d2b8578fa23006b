"""The bones of a hip's CT named without a network and without a shape: heads by their spheres, joints by graph cuts.

What is bone is told by `sheets`. A femoral head is where many sheets of bone stand square to lines through one point,
with bone inside and above. Seen from the heads, some places belong to one bone in every adult: the middle of the head
and what lies beside and below it to the femur, what lies well above it or on its inner side to the hip bone, the
midline behind to the sacrum, what lies far beside it to the ilium. Between such places a minimum cut runs where the CT
is dark.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from torch import from_numpy

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.errors import InputError
from femoreg_torch.segment.sheets import APART, BONE, OUTSIDE, UNDECIDED, Links, Mask, Values, bone_of, minimum_cut
from femoreg_torch.segment.sphere_votes import (
    COARSE_MM,
    RADII_MM,
    RIDGE_RANGE_HU,
    Points,
    along_rays,
    directions,
    sphere_votes,
)
from femoreg_torch.volume import Volume, resample_isotropic

VOXEL_MM = 1.25
_DARKEST_HU, _BRIGHTEST_HU = -200.0, 1500.0  # beyond is air, or metal

_CANDIDATES = 40
_INSIDE_HU = 170.0  # of spongy bone in a head, and of any bone
_INSIDE_MM = 15.0
_ROOF_MM, _ROOF_UP, _ROOF_SHARE = (32.0, 55.0), 0.6, 0.3  # above the head lies the ilium
_SLANT, _SLANT_MM, _ASIDE = (0.2, 0.7), (25.0, 60.0), 0.3  # upwards, so far, and to a side
_HEADS_APART_MM, _HEADS_ASKEW_MM = (110.0, 260.0), 70.0
_OTHER_SHARE = 0.25  # of the score of the first head, which the second needs
_LEAST_SCORE = 0.002
# How much of a head is femur, and in how many directions inwards and up a hip bone lies at most 12 mm beyond it. In
# three real CTs and two simulated ones at least 0.95, and 1.00; in a CT of two knees 0.41 and 0.69.
_HEAD_SHARE, _SOCKET_SHARE = 0.7, 0.85
_SOCKET_MM, _SOCKET, _SOCKET_COSINE = 12.0, (0.8, 0.6), 0.5  # inwards and up; cosine of the angle to that
_HALF_HEADS_MM = 88.0  # half the distance of the heads of adults, where only one is in the CT

# The cost of a face of a cut, of bone as bright as this 1.15, in the darkest sheet e^−3 of it.
_CUT_BRIGHT_HU, _CUT_LEAST, _CUT_DARK = 400.0, 0.15, 3.0
_UNIT = 100  # capacity of a cost of 1
_GAP_MM = 10.0  # between parts of a femur
_NECK, _NECK_COSINE = (0.8, -0.6), 0.2  # outwards and up; around the head all but this way lies the socket


@dataclass(frozen=True, eq=False)
class Head:
    """A femoral head."""

    centre: Points  # (3,) LPS mm
    radius: float  # mm
    score: float


@dataclass(frozen=True, eq=False)
class _Frame:
    """Millimetres to the left, back and up from the middle of the heads, for every voxel of a grid."""

    left: Values
    back: Values
    up: Values
    heads: dict[str, tuple[Points, float]]  # by side: left, back, up of the centre; radius


def bones_without_network(ct: Volume, anatomy: Anatomy) -> Volume:
    """Labels of hip bones, femora, sacrum and vertebrae (0, or 1 + the bone's number) on cubic voxels of 1.25 mm.

    Raises `InputError` if there is no femoral head, or none in a socket.
    """
    grid = resample_isotropic(ct, VOXEL_MM)
    hu = grid.data.float().clamp(_DARKEST_HU, _BRIGHTEST_HU).numpy()
    heads = femoral_heads(ct)
    if not heads:
        raise InputError("segment: no femoral head was found. A CT of the hip was expected.")
    bone, sheets = bone_of(hu, VOXEL_MM)
    frame = _frame(heads, grid)
    found = _named(bone, _cost_of_a_cut(hu, sheets), frame, anatomy)
    if not any(_is_joint(found, head, side, grid, anatomy) for side, head in zip(frame.heads, heads, strict=True)):
        place = ", ".join(f"{value:.0f}" for value in heads[0].centre)
        raise InputError(
            f"segment: what looks like a femoral head, at LPS {place} mm with a radius of {heads[0].radius:.0f} mm, "
            "lies in no socket of a hip bone. A CT of the hip was expected: is it of another joint?"
        )
    return grid.with_data(from_numpy(found))


def femoral_heads(ct: Volume) -> list[Head]:
    """None, one, or two femoral heads of a CT in HU, the left one first."""
    coarse = resample_isotropic(ct, COARSE_MM)
    hu = coarse.data.float().clamp(*RIDGE_RANGE_HU).numpy()
    votes, radii = sphere_votes(hu)
    peaks = np.argwhere((votes == ndimage.maximum_filter(votes, 9)) & (votes > 0))
    peaks = peaks[np.argsort(-votes[tuple(peaks.T)])][:_CANDIDATES]
    bright = (hu > _INSIDE_HU).astype(np.float32)
    affine = coarse.lps_from_index.numpy()
    found = [
        Head(
            affine[:3, :3] @ peak[::-1] + affine[:3, 3],
            float(radii[tuple(peak)]),
            float(votes[tuple(peak)]) * _in_a_socket(bright, peak),
        )
        for peak in peaks
    ]
    found = [head for head in found if head.score > _LEAST_SCORE]
    first = max(found, key=lambda head: head.score, default=None)
    if first is None or not _has_a_radius(first):
        return []
    others = [
        head
        for head in found
        if head.score > _OTHER_SHARE * first.score and _may_be_pair(head, first) and _has_a_radius(head)
    ]
    if not others:
        return [first]
    return sorted([first, max(others, key=lambda head: head.score)], key=lambda head: -head.centre[0])


def _in_a_socket(bright: Values, place: NDArray[np.intp]) -> float:
    """How much of the inside of a head there is bone, times the share of directions upwards that meet bone above."""
    every = directions()
    inside = _along(bright, place, every, 0.0, _INSIDE_MM).mean()
    roof = _along(bright, place, every[every[:, 0] > _ROOF_UP], *_ROOF_MM).mean(1) > _ROOF_SHARE
    return float(inside * roof.mean())


def _along(
    values: Values,
    place: NDArray[np.intp] | Points,
    ways: Points,
    first_mm: float,
    last_mm: float,
    voxel_mm: float = COARSE_MM,
) -> Values:
    """Values (ways, steps) along rays from a voxel, every 1.5 mm."""
    return along_rays(values, np.asarray(place, float), ways, np.arange(first_mm, last_mm, 1.5) / voxel_mm)


def _is_joint(labels: NDArray[np.uint8], head: Head, side: str, grid: Volume, anatomy: Anatomy) -> bool:
    """Whether a head belongs to its femur and lies under its hip bone, by the labels (Z, Y, X) that it led to."""
    femur, hip = (
        (labels == 1 + anatomy.bone_names.index(f"{bone}_{side}")).astype(np.float32) for bone in ("femur", "hip")
    )
    affine = grid.lps_from_index.numpy()
    place = np.linalg.solve(affine[:3, :3], head.centre - affine[:3, 3])[::-1]
    every = directions()
    inwards = -every[:, 2] if side == "left" else every[:, 2]
    roof = every[_SOCKET[0] * inwards + _SOCKET[1] * every[:, 0] > _SOCKET_COSINE]
    inside = _along(femur, place, every, 0.0, head.radius - 3, VOXEL_MM).mean()
    socket = _along(hip, place, roof, head.radius - 1, head.radius + _SOCKET_MM, VOXEL_MM).max(1) > 0.5
    return bool(inside > _HEAD_SHARE and socket.mean() > _SOCKET_SHARE)


def _has_a_radius(head: Head) -> bool:
    """Whether a sphere fits best at a radius between the smallest and the largest that were tried."""
    return bool(RADII_MM[0] < head.radius < RADII_MM[-1])


def _may_be_pair(one: Head, other: Head) -> bool:
    apart = np.abs(one.centre - other.centre)
    near, far = _HEADS_APART_MM
    return bool(near < apart[0] < far and apart[1:].max() < _HEADS_ASKEW_MM)


def _frame(heads: list[Head], grid: Volume) -> _Frame:
    """The frame of the heads; of one alone it is told on which side of it the pelvis lies."""
    affine = grid.lps_from_index.numpy()
    if len(heads) == 2:
        across = heads[0].centre - heads[1].centre
        left = across / np.linalg.norm(across)
        middle = (heads[0].centre + heads[1].centre) / 2
        sides = {"left": heads[0], "right": heads[1]}
    else:
        left = np.array([1.0, 0.0, 0.0])
        side = _side_of(heads[0], resample_isotropic(grid, COARSE_MM))
        middle = heads[0].centre - (_HALF_HEADS_MM if side == "left" else -_HALF_HEADS_MM) * left
        sides = {side: heads[0]}
    up = np.array([0.0, 0.0, 1.0]) - left[2] * left
    up /= np.linalg.norm(up)
    axes: Points = np.stack([left, np.cross(up, left), up])
    x, y, z = np.ogrid[tuple(slice(n) for n in reversed(grid.data.shape))]
    steps = axes @ affine[:3, :3]
    starts = axes @ (affine[:3, 3] - middle)
    along = [
        (start + i * x + j * y + k * z).astype(np.float32).T for start, (i, j, k) in zip(starts, steps, strict=True)
    ]
    places = {side: (axes @ (head.centre - middle), head.radius) for side, head in sides.items()}
    return _Frame(along[0], along[1], along[2], places)


def _side_of(head: Head, ct: Volume) -> str:
    """Whose head it is: somewhat above a head there is bone, the ilium, on the inner side alone."""
    hu, affine = ct.data.float().numpy(), ct.lps_from_index.numpy()
    place = np.linalg.solve(affine[:3, :3], head.centre - affine[:3, 3])[::-1]
    slant = directions()
    slant = slant[(slant[:, 0] > _SLANT[0]) & (slant[:, 0] < _SLANT[1])]
    bright = _along((hu > _INSIDE_HU).astype(np.float32), place, slant, *_SLANT_MM).mean(1)
    return "left" if bright[slant[:, 2] < -_ASIDE].mean() > bright[slant[:, 2] > _ASIDE].mean() else "right"


def _cost_of_a_cut(hu: Values, sheets: Values) -> Values:
    """What it costs (Z, Y, X) to part a bone at a voxel: least in dark sheets, most in bright bone."""
    bright = (hu / _CUT_BRIGHT_HU).clip(0, 1) + _CUT_LEAST
    return (bright * np.exp(-_CUT_DARK * np.maximum(0, -sheets))).astype(np.float32)


def _parted(part: Mask, one: Mask, other: Mask, cost: Values) -> Mask:
    """What of `part` lies on the side of `one`, by the cheapest cut from `other`; both are places within it."""
    if not (part & one).any():
        return np.zeros_like(part)
    box = ndimage.find_objects(part.astype(np.uint8))[0]
    stand = np.where(part, UNDECIDED, APART)[box].astype(np.uint8)
    stand[(part & one)[box]] = BONE
    stand[(part & other)[box]] = OUTSIDE
    links = []
    for axis in range(3):
        low, high = (tuple(s if k == axis else slice(None) for k in range(3)) for s in (slice(-1), slice(1, None)))
        face = (_UNIT * np.minimum(cost[box][low], cost[box][high])).astype(np.int32) + 1
        links.append(Links(face, face))
    result = np.zeros_like(part)
    result[box] = minimum_cut(stand, np.zeros(stand.shape, np.int32), links)
    return result


def _named(bone: Mask, cost: Values, frame: _Frame, anatomy: Anatomy) -> NDArray[np.uint8]:
    """Labels (Z, Y, X): 0, or 1 + the number in the anatomy. Distances are mm in the frame of the heads."""
    number = {name: 1 + n for n, name in enumerate(anatomy.bone_names)}
    labels = np.zeros(bone.shape, np.uint8)
    left, back, up, beside = frame.left, frame.back, frame.up, np.abs(frame.left)
    pelvis = bone.copy()
    for side, head in frame.heads.items():
        femur = _femur(pelvis, cost, frame, *head, 1 if side == "left" else -1)
        labels[femur] = number[f"femur_{side}"]
        pelvis &= ~femur
    middle = (beside < 14) & (back > 10) & (up > -60) | (beside < 28) & (up > 20) & (back > 10)
    middle |= (beside < 38) & (up > 50) & (back > 10) & (back < 40) | (beside < 25) & (up > 40) & (back > 0)
    middle |= (beside < 40) & (up > 130)
    outer = (beside > 70) | (back < 5) & (up < 45)
    axial = _parted(pelvis, middle, outer, cost)
    hips = pelvis & ~axial
    close = hips & (beside < 20)
    at_left = np.where(close, _parted(close, left > 12, left < -12, cost), left > 0)
    labels[hips & at_left] = number["hip_left"]
    labels[hips & ~at_left] = number["hip_right"]
    labels[axial] = number["sacrum"]
    joint = up[axial & ndimage.binary_dilation(hips, iterations=2)]
    if len(joint):
        top = float(np.percentile(joint, 90))
        labels[_parted(axial & (up > top - 20), up > top + 40, up < top - 15, cost)] = number["vertebrae"]
    return labels


def _femur(bone: Mask, cost: Values, frame: _Frame, centre: Points, radius: float, sign: int) -> Mask:
    """The femur of the head at `centre`, whose outer side lies along `sign` times the frame's left."""
    outwards, back, above = sign * (frame.left - centre[0]), frame.back - centre[1], frame.up - centre[2]
    away = np.sqrt(outwards**2 + back**2 + above**2)
    inside = away < radius - 5
    femur = inside | (outwards > radius + 10) & (outwards < radius + 60) & (above < radius)
    femur |= (outwards > 5) & (above < -radius - 12) | (above < -130)
    pelvis = (above > radius + 12) | (outwards < -radius - 10)
    towards_neck = _NECK[0] * outwards + _NECK[1] * above
    pelvis |= (away > radius + 6) & (away < radius + 20) & (towards_neck < _NECK_COSINE * away)
    part = bone & (outwards > -radius - 14) & (above < radius + 16)
    return _main_part(_parted(part, femur & ~pelvis, pelvis, cost), inside)


def _main_part(mask: Mask, around: Mask) -> Mask:
    """What holds most of a place, over gaps of 10 mm at most: dark marrow may part a femur; a forearm lies farther."""
    parts, count = ndimage.label(ndimage.binary_dilation(mask, iterations=round(_GAP_MM / 2 / VOXEL_MM)))
    here = np.bincount(parts[around & mask], minlength=count + 1)
    here[0] = 0
    return mask & (parts == here.argmax())
