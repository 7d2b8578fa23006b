"""From the network's shares on coarse voxels to labels on the CT's own: the bones' edges are where the CT has them.

The network says which bone lies where, to about a coarse voxel; in that band the CT decides. A voxel there is bone if
it is brighter than a threshold between soft tissue and the brightest bone near it, as edges of a blurred plate lie at a
part of its height (Prevrhal et al., Phys. Med. Biol. 44, 1999, of cortex in CT). A low threshold first, so that cortex
has no gaps and encloses its marrow, which is kept by the network's share and by closing. Then the crest of the cortex
says what lies beyond it and what within (`crest`), also where the network is wrong by a few millimetres; then the
edge itself. Joints are opened, and last femoral heads filled to the sphere of their cortex (`whole_heads`).
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from skimage.segmentation import watershed
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.segment.boxes import Mask, radius
from femoreg_torch.segment.crest import sides_of_the_crest
from femoreg_torch.segment.whole_heads import METAL_HU, SOFT_HU, whole_heads
from femoreg_torch.volume import Volume

_FINEST_MM = 1.0  # finer voxels are averaged; labels then lie within half a millimetre
_MARGIN_MM = 9.0  # around what the network labels
# Of the way from soft tissue to the brightest bone within `_NEAR_MM`, and bounds in HU. Above the first, thin and
# blurred cortex still hangs together, so that marrow is enclosed. At half the way lies the edge of a plate that is wide
# beside the scanner's blur; voxels that are reached from outside are asked for that.
_WHOLE_SHARE, _LOWEST_WHOLE_HU, _HIGHEST_WHOLE_HU = 0.35, 130.0, 300.0
_EDGE_SHARE, _LOWEST_EDGE_HU, _HIGHEST_EDGE_HU = 0.5, 130.0, 600.0
_RIM_MM = 1.5  # depth of what is asked so, at least one voxel
_WITHIN_SHARE = 0.15  # of all bones, which what lies within the crest must have
_BEYOND_MM = 4.5  # depth to which dark voxels beyond the crest are taken off, whatever the network says
_CHANNELLED = "sacrum"  # nerves run through it, in foramina
_CHANNEL_MM = 12.0  # and so deep are they taken off there, from either end of a channel
_WALL_SEEN_MM = 2.0  # the largest voxels, along two axes, on which the wall of a foramen is seen
_NEAR_MM = 3.0
_SOFTNESS_HU = 100.0  # about the threshold, over which the CT's evidence goes from −1 (no bone) to 1 (bone)
_CT_WEIGHT = 0.35  # of the CT's evidence beside the network's share: 0.15 to 0.85 is the band where the CT decides
_JOINT_WEIGHT = 2.0  # where hip bone and femur are equally likely lies the joint space, and the CT decides
_JOINT_SHARE = 0.05  # of either bone: where the joint has settled the edge
_METAL_MM = 3.0  # in metal and so far around it the network decides alone
_CLOSE_MM = 2.0  # gaps so wide within a bone are marrow, where the network agrees
_CLOSED_SHARE = 0.4
_SURE_MM = 3.0  # a voxel so far from the other bone is surely of its own
_VALLEY_MM = 0.7  # standard deviation of the blur that takes the noise off the joint space
_BRIDGE_HU = 250.0  # between two bones; cartilage and fluid are far below
_LINE_MM = 1.5  # the largest voxels of a line that parts two bones
_LEAST_PART, _LEAST_PART_ML = 0.1, 1.0  # of the largest part of a bone; smaller ones are dropped


@dataclass(frozen=True, eq=False)
class _Region:
    """The part of the CT that is worked on. Voxel (x, y, z) lies at corner + step · index, in the CT's voxels."""

    hu: Tensor  # (Z, Y, X) float32
    corner: NDArray[np.float64]  # (3,) x, y, z
    step: NDArray[np.float64]  # (3,) CT voxels per voxel
    spacing: NDArray[np.float64]  # (3,) mm


def refined_labels(ct: Volume, shares: Tensor, grid: Volume, anatomy: Anatomy) -> Tensor:
    """Labels (Z, Y, X) uint8 on the grid of `ct`: 0, or 1 + the bone's number in the anatomy.

    `shares` (classes, z, y, x) are the network's on `grid`, whose voxels follow the same axes as those of `ct`.
    """
    labels = torch.zeros(ct.data.shape, dtype=torch.uint8)
    coarse = shares.argmax(0)
    if not bool((coarse > 0).any()):
        return labels
    region = _region(ct, coarse > 0, grid)
    bone, which, joint = _on_region(shares, region, ct, grid, anatomy)
    brightest = _largest_near(region.hu.clamp(-200, 1500), radius(_NEAR_MM, region.spacing))
    whole = _threshold(brightest, _WHOLE_SHARE, _LOWEST_WHOLE_HU, _HIGHEST_WHOLE_HU)
    found = torch.where(_is_bone(bone - _JOINT_WEIGHT * joint, region, whole), which, 0).numpy()
    for number in range(1, shares.shape[0]):
        found = _whole(found, number, bone.numpy(), region.spacing)
    seen = np.sort(region.spacing)[1] <= _WALL_SEEN_MM
    channelled = 1 + anatomy.bone_names.index(_CHANNELLED) if seen else 0
    sides = sides_of_the_crest(found, bone.numpy(), region.hu.numpy(), region.spacing, channelled)
    found = np.where((found == 0) & (bone > _WITHIN_SHARE).numpy(), sides.within, found)
    edge = _threshold(brightest, _EDGE_SHARE, _LOWEST_EDGE_HU, _HIGHEST_EDGE_HU)
    at_joint = joint > _JOINT_SHARE
    may_go = ((region.hu < edge) & ~_near_metal(region) & ~at_joint).numpy()
    dark = sides.beyond & may_go
    settled = (_is_bone(bone, region, edge) | at_joint).numpy() & ~dark | (sides.within > 0)
    found = _trimmed(found, settled, _RIM_MM, region.spacing)
    channels = sides.clearly_beyond & may_go & (found == channelled)
    without_channels = _trimmed(found, ~channels, _CHANNEL_MM, region.spacing)
    found = np.minimum(_trimmed(found, ~dark, _BEYOND_MM, region.spacing), without_channels)
    found = opened_joints(found, region.hu.numpy(), region.spacing, anatomy)
    found = whole_heads(found, region.hu.numpy(), region.spacing, anatomy)
    return _onto(labels, torch.from_numpy(found), region)


def unrefined_labels(ct: Volume, shares: Tensor, grid: Volume, anatomy: Anatomy) -> Tensor:
    """As `refined_labels`, from the network alone: the most probable class at each voxel (Z, Y, X)."""
    labels = torch.zeros(ct.data.shape, dtype=torch.uint8)
    coarse = shares.argmax(0)
    if not bool((coarse > 0).any()):
        return labels
    region = _region(ct, coarse > 0, grid)
    bone, which, _ = _on_region(shares, region, ct, grid, anatomy)
    return _onto(labels, torch.where(bone > 0.5, which, 0).to(torch.uint8), region)


def _region(ct: Volume, inside: Tensor, grid: Volume) -> _Region:
    spacing, size = np.array(ct.spacing_mm), np.array(ct.data.shape[::-1])
    where = torch.nonzero(inside).flip(1).numpy()  # x, y, z
    ratio = np.array(grid.spacing_mm) / spacing
    low = np.floor(where.min(0) * ratio - _MARGIN_MM / spacing).clip(0).astype(int)
    high = np.minimum(np.ceil((where.max(0) + 1) * ratio + _MARGIN_MM / spacing).astype(int), size)
    hu = ct.data[low[2] : high[2], low[1] : high[1], low[0] : high[0]].float()
    count = np.maximum(1, np.round((high - low) * np.minimum(1, spacing / _FINEST_MM)).astype(int))
    step = (high - low) / count
    for axis in range(3):
        hu = _averaged(hu, 2 - axis, int(count[axis]))
    return _Region(hu.contiguous(), low + (step - 1) / 2, step, step * spacing)


def _averaged(values: Tensor, axis: int, count: int) -> Tensor:
    """The same along one axis with fewer voxels, each the mean over its width."""
    if values.shape[axis] == count:
        return values
    moved = values.movedim(axis, -1)
    flat = moved.reshape(1, -1, moved.shape[-1])
    shorter = F.interpolate(flat[:, :, None], size=(1, count), mode="bilinear", antialias=True)[:, :, 0]
    return shorter.reshape(*moved.shape[:-1], count).movedim(-1, axis)


def _on_region(
    shares: Tensor, region: _Region, ct: Volume, grid: Volume, anatomy: Anatomy
) -> tuple[Tensor, Tensor, Tensor]:
    """Share of all bones together, the number of the most probable one, and the lesser one of the shares of hip bones
    and femora; each (Z, Y, X), by linear interpolation.
    """
    ratio = np.array(ct.spacing_mm) / np.array(grid.spacing_mm)
    places = []
    for axis, count in enumerate(reversed(region.hu.shape)):
        index = region.corner[axis] + region.step[axis] * np.arange(count)
        places.append(torch.from_numpy((index + 0.5) * ratio[axis] - 0.5))
    best = torch.zeros(region.hu.shape)
    which = torch.ones(region.hu.shape, dtype=torch.uint8)
    total = torch.zeros(region.hu.shape)
    sides = {"hip": torch.zeros(region.hu.shape), "femur": torch.zeros(region.hu.shape)}
    for number in range(1, shares.shape[0]):
        if float(shares[number].max()) < 0.05:
            continue
        values = shares[number]
        for axis in range(3):
            values = _linear(values, places[axis], 2 - axis)
        total += values
        which[values > best] = number
        best = torch.maximum(best, values)
        kind = anatomy.bone_names[number - 1].partition("_")[0]
        if kind in sides:
            sides[kind] = torch.maximum(sides[kind], values)
    return total, which, torch.minimum(sides["hip"], sides["femur"])


def _linear(values: Tensor, places: Tensor, axis: int) -> Tensor:
    """Values at fractional positions along one axis, beyond its ends those of the ends."""
    places = places.clamp(0, values.shape[axis] - 1)
    below = places.long().clamp(max=max(0, values.shape[axis] - 2))
    above = (below + 1).clamp(max=values.shape[axis] - 1)
    share = (places - below).float().reshape([-1 if k == axis else 1 for k in range(3)])
    first = values.index_select(axis, below)
    return first + share * (values.index_select(axis, above) - first)


def _threshold(brightest: Tensor, share: float, lowest: float, highest: float) -> Tensor:
    """HU above which a voxel is bone, from the brightest bone near it."""
    return (SOFT_HU + share * (brightest - SOFT_HU)).clamp(lowest, highest)


def _is_bone(bone: Tensor, region: _Region, threshold: Tensor) -> Tensor:
    """Where the network's share of bone and the CT together say bone (Z, Y, X)."""
    evidence = ((region.hu - threshold) / _SOFTNESS_HU).clamp(-1, 1)
    evidence[_near_metal(region)] = 0
    return (bone - 0.5) + _CT_WEIGHT * evidence > 0


def _near_metal(region: _Region) -> Tensor:
    metal = region.hu > METAL_HU
    return _largest_near(metal.float(), radius(_METAL_MM, region.spacing)) > 0 if bool(metal.any()) else metal


def _trimmed(
    labels: NDArray[np.uint8], settled: Mask, depth_mm: float, spacing: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The labels, so deep from outside, without what is not `settled`, which keeps what lies behind it."""
    layers = radius(depth_mm, spacing)
    outside, may_be = labels == 0, (labels == 0) | ~settled
    for n in range(max(layers)):
        step = ndimage.generate_binary_structure(3, 1)
        for axis, most in enumerate(layers):
            if n >= most:  # deep enough along the longer edges of voxels
                step.swapaxes(0, axis)[[0, 2]] = False
        outside = ndimage.binary_dilation(outside, step, mask=may_be)
    return np.where(outside, 0, labels).astype(np.uint8)


def _largest_near(values: Tensor, radius: tuple[int, int, int]) -> Tensor:
    """Largest value in a box around each voxel, one axis after the other."""
    for axis, r in enumerate(radius):
        size = [1, 1, 1]
        size[axis] = 2 * r + 1
        padding = [0, 0, 0]
        padding[axis] = r
        values = F.max_pool3d(values[None], size, 1, padding)[0]
    return values


def _whole(
    labels: NDArray[np.uint8], number: int, bone: NDArray[np.float32], spacing: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The labels with one bone closed, its holes filled, and small stray parts dropped."""
    box = ndimage.find_objects(labels == number, 1)[0]
    if box is None:
        return labels
    room = radius(_CLOSE_MM, spacing)
    box = tuple(slice(max(0, s.start - r - 1), s.stop + r + 1) for s, r in zip(box, room, strict=True))
    part, share = labels[box], bone[box]
    mask = part == number
    parts, count = ndimage.label(mask)
    if count > 1:
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        least = max(_LEAST_PART * sizes.max(), _LEAST_PART_ML * 1000 / float(np.prod(spacing)))
        mask = (sizes >= min(least, sizes.max()))[parts]
    ball = np.ones([2 * r + 1 for r in room], bool)
    padded = np.pad(mask, [(r, r) for r in room], mode="edge")
    closed = ndimage.binary_erosion(_dilated(padded, ball), ball, border_value=1)
    closed = closed[tuple(slice(r, n - r) for r, n in zip(room, closed.shape, strict=True))]
    mask = mask | (closed & (share > _CLOSED_SHARE) & (part == 0))
    filled = ndimage.binary_fill_holes(mask) & ((part == 0) | (part == number))
    result = labels.copy()
    inside = result[box]
    inside[part == number] = 0
    inside[filled] = number
    return result


def _dilated(mask: Mask, box: Mask) -> Mask:
    return np.asarray(ndimage.maximum_filter(mask, box.shape), bool)


def opened_joints(
    labels: NDArray[np.uint8], hu: NDArray[np.float32], spacing: NDArray[np.float64], anatomy: Anatomy
) -> NDArray[np.uint8]:
    """The labels with femur and hip bone apart: between them runs a line of free voxels, where the CT is darkest.

    A watershed (Meyer, Signal Processing 38, 1994) of the CT, brightest first, from what lies `_SURE_MM` within either
    bone. On voxels larger than `_LINE_MM` the line would be wider than a joint space; there only voxels that are darker
    than around are freed.
    """
    result = labels.copy()
    room = radius(_SURE_MM, spacing)
    for side in ("left", "right"):
        femur, hip = (1 + anatomy.bone_names.index(f"{bone}_{side}") for bone in ("femur", "hip"))
        touching = contact(labels, femur, hip)
        if not touching.any():
            continue
        box = tuple(
            slice(max(0, s.start - 3 * r), s.stop + 3 * r)
            for s, r in zip(ndimage.find_objects(touching.astype(np.uint8))[0], room, strict=True)
        )
        part = result[box]
        both = (part == femur) | (part == hip)
        size = [2 * r + 1 for r in room]
        markers = np.zeros(part.shape, np.int32)
        for number, other in ((femur, hip), (hip, femur)):
            markers[(part == number) & ~(ndimage.maximum_filter(part == other, size))] = number
        rim = np.ones(part.shape, bool)
        rim[1:-1, 1:-1, 1:-1] = False  # beyond it nothing changes, so that nothing may change on it
        markers[rim & both] = part[rim & both]
        fine = bool(spacing.max() <= _LINE_MM)
        smooth = ndimage.gaussian_filter(hu[box], _VALLEY_MM / spacing[::-1])
        apart = watershed(-smooth, markers, mask=both, watershed_line=fine)
        part[both] = apart[both]
        dark = fine | (hu[box] < ndimage.uniform_filter(hu[box], 3))
        part[contact(part, femur, hip) & dark] = 0
    return result


def closed_joint_mm2(
    labels: NDArray[np.uint8], hu: NDArray[np.float32], femur: int, hip: int, spacing: NDArray[np.float64]
) -> float:
    """Area, mm², over which femur and hip bone touch, or only voxels as bright as bone part them: no gap is seen.

    `labels` and `hu` (Z, Y, X) stand on one grid, whose spacing (3,) is in mm along x, y, z.
    """
    one_box, other_box = (ndimage.find_objects(labels == number, 1)[0] for number in (femur, hip))
    if one_box is None or other_box is None:
        return 0.0
    box = tuple(
        slice(max(0, max(one.start, other.start) - 2), min(one.stop, other.stop) + 2)
        for one, other in zip(one_box, other_box, strict=True)
    )
    part, bright = labels[box], hu[box] > _BRIDGE_HU
    if not part.size:
        return 0.0
    x, y, z = spacing
    face_mm2 = float(np.mean([x * y, x * z, y * z]))
    reach = 1 if spacing.min() > 0.9 * _FINEST_MM else 2  # a line of `_FINEST_MM` is at most so many voxels wide
    beside = [ndimage.binary_dilation(part == number, iterations=reach) for number in (femur, hip)]
    bridged = (part == 0) & bright & beside[0] & beside[1]
    return face_mm2 * (float(contact(part, femur, hip).sum()) / 2 + float(bridged.sum()) / reach)


def contact(labels: NDArray[np.uint8], one: int, other: int) -> Mask:
    """Voxels (Z, Y, X) of either label that share a face with the other."""
    first, second = labels == one, labels == other
    if not (first.any() and second.any()):
        return np.zeros(labels.shape, bool)
    return (first & ndimage.binary_dilation(second)) | (second & ndimage.binary_dilation(first))


def _onto(labels: Tensor, found: Tensor, region: _Region) -> Tensor:
    """The region's labels at their places in the CT, by nearest neighbour."""
    low = np.round(region.corner - (region.step - 1) / 2).astype(int)
    index = []
    for axis in range(3):
        count = round(float(region.step[axis]) * found.shape[2 - axis])
        own = ((np.arange(count) + 0.5) / region.step[axis]).astype(int).clip(0, found.shape[2 - axis] - 1)
        index.append(torch.from_numpy(own))
    x, y, z = index
    part = found.to(torch.uint8)[z][:, y][:, :, x]
    labels[low[2] : low[2] + len(z), low[1] : low[1] + len(y), low[0] : low[0] + len(x)] = part
    return labels
