"""The bones of a CT: labels on its own grid, how sure they are, and what to look at before they are used."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP, Anatomy
from femoreg_torch.errors import InputError
from femoreg_torch.segment.heads import Head, doubted_radius, doubted_slices, fitted_heads
from femoreg_torch.segment.network import BoneNetwork, bone_shares
from femoreg_torch.segment.refine import closed_joint_mm2, refined_labels, unrefined_labels
from femoreg_torch.segment.without_network import bones_without_network
from femoreg_torch.volume import Volume, resample_isotropic
from femoreg_torch.volume.borders import cut_bones
from femoreg_torch.volume.contradictions import intercept_twice
from femoreg_torch.volume.round_field import round_field

_BONE_HU, _METAL_HU = 200.0, 2800.0
_LEAST_HIP_ML = 15.0  # of a hip bone; whole ones of adults have 180 to 400
_LEAST_FEMUR_ML = 10.0
_SHARES_MM = 3.0  # voxels on which the cuts' labels are averaged for the refinement; 1.5 to 2 mm gave the same
_EMPTY_HU = -200.0  # mean below which a bone is none: marrow is fat, -100 HU, and bone is about it
_LEAST_CONFIDENCE = 0.6  # mean probability of a bone; with less it is left out
_LEAST_TOLD_ML = 0.5  # of what is left out; less are specks that nobody takes for a bone
_DOUBTED = 0.85  # mean share of a bone below which a warning is given
_CLOSED_MM2 = 150.0  # of femur and hip bone without a gap; a head has some 5000 mm² in its socket
_METAL_ML = 0.5
_MAIN_PART = 0.3  # of the largest part of the hip bones; smaller ones may be stray specks
_SIDE_SHARE = {"femur": 0.6, "hip": 0.97}  # a part with so much of one side is all of it; hip bones may meet


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Bones found in a CT."""

    labels: Volume  # uint8 on the CT's grid: 0, or 1 + the bone's number in the anatomy
    confidence: dict[str, float]  # by bone: mean probability that the network gives its voxels; empty without one
    volume_ml: dict[str, float]  # by bone
    warnings: tuple[str, ...]
    heads: dict[str, Head]  # by side


def segment_bones(ct: Volume, network: BoneNetwork, refine: bool = True) -> Segmentation:
    """Hip bones, sacrum, femora and vertebrae of a CT in HU.

    With `refine` their edges are those of the CT (`refined_labels`), without it those of the network. Raises
    `InputError` if there is no bone, or neither a hip bone nor an upper femur.
    """
    bright_ml = _bright_ml(ct)
    shares, grid = bone_shares(network, ct)
    shares = _spine_apart(_sides_told_apart(shares, network), network)
    anatomy = network.anatomy
    data = refined_labels(ct, shares, grid, anatomy) if refine else unrefined_labels(ct, shares, grid, anatomy)
    present = torch.unique(data).tolist()
    confidence = {name: _confidence(shares, 1 + n) for n, name in enumerate(anatomy.bone_names) if 1 + n in present}
    return _looked_at(ct, data, anatomy, confidence, bright_ml)


def segment_bones_without_network(ct: Volume, refine: bool = True) -> Segmentation:
    """As `segment_bones`, by sheetness, graph cuts and the heads' spheres; there is no confidence.

    With `refine` the edges are those of the CT, found as around a network's labels; without it those of the cuts, on
    voxels of 1.25 mm.
    """
    bright_ml = _bright_ml(ct)
    cut = bones_without_network(ct, HIP)
    if refine:
        grid = resample_isotropic(ct, _SHARES_MM)
        shares = [_averaged(cut.with_data((cut.data == k).float()), grid) for k in range(1 + len(HIP.bones))]
        data = refined_labels(ct, torch.stack(shares), grid, HIP)
    else:
        z, y, x = (
            ((torch.arange(n) + 0.5) * (float(own) / float(other))).long().clamp(max=most - 1)
            for n, own, other, most in zip(
                ct.data.shape, reversed(ct.spacing_mm), reversed(cut.spacing_mm), cut.data.shape, strict=True
            )
        )
        data = cut.data[z][:, y][:, :, x]
    return _looked_at(ct, data, HIP, {}, bright_ml)


def _averaged(mask: Volume, grid: Volume) -> Tensor:
    """A mask averaged on the voxels of `grid`, whose first outer faces are the mask's; the far ones need not be."""
    more = math.ceil(max(grid.spacing_mm) / min(mask.spacing_mm))
    beyond = F.pad(mask.data[None, None], (0, more) * 3, mode="replicate")[0, 0]
    z, y, x = grid.data.shape
    return resample_isotropic(Volume(beyond, mask.lps_from_index), _SHARES_MM).data[:z, :y, :x]


def _bright_ml(ct: Volume) -> float:
    """What is as bright as bone, ml. Raises `InputError` if there is next to nothing."""
    bright_ml = float((ct.data > _BONE_HU).sum()) * float(np.prod(ct.spacing_mm)) / 1000
    if bright_ml < _LEAST_FEMUR_ML:
        raise InputError(
            f"segment: only {bright_ml:.1f} ml of the CT are above {_BONE_HU:g} HU, so it holds no bone. Is it in HU?"
        )
    return bright_ml


def _looked_at(
    ct: Volume, data: Tensor, anatomy: Anatomy, confidence: dict[str, float], bright_ml: float
) -> Segmentation:
    """The labels without doubtful bones, with what there is to say. Raises `InputError` if they hold no hip."""
    counts = torch.bincount(data.flatten(), minlength=1 + len(anatomy.bones)).tolist()
    voxel_ml = float(np.prod(ct.spacing_mm)) / 1000
    volume_ml = {name: n * voxel_ml for name, n in zip(anatomy.bone_names, counts[1:], strict=True) if n}
    labelled = data > 0
    sums = torch.bincount(data[labelled], ct.data[labelled].double(), 1 + len(anatomy.bones)).tolist()
    empty = {
        name: total / n
        for name, total, n in zip(anatomy.bone_names, sums[1:], counts[1:], strict=True)
        if n and total / n < _EMPTY_HU
    }
    unsure = [name for name, share in confidence.items() if share < _LEAST_CONFIDENCE and name not in empty]
    doubtful = [*empty, *unsure]
    hips = [side for side in ("left", "right") if _is_there(volume_ml, doubtful, f"hip_{side}", _LEAST_HIP_ML)]
    femora = [side for side in ("left", "right") if _is_there(volume_ml, doubtful, f"femur_{side}", _LEAST_FEMUR_ML)]
    if not hips or not femora:
        lacking = " and ".join(name for name, there in (("hip bone", hips), ("upper femur", femora)) if not there)
        raise InputError(
            f"segment: no {lacking} was found in {bright_ml:.0f} ml of bone. A CT of the hip was expected: "
            + (intercept_twice(ct) or "is it of another part of the body, or turned against what its header says?")
        )
    left_out = []
    for name in doubtful:
        data[data == 1 + anatomy.bone_names.index(name)] = 0
        left_ml, share = volume_ml.pop(name), confidence.pop(name, None)
        if left_ml < _LEAST_TOLD_ML:
            continue
        if name in empty:
            told, why = f"mean {empty[name]:.0f} HU", "no bone is as thin as air"
        else:
            told, why = f"mean probability {share:.2f}", "the network is not sure"
        left_out.append(f"what may be {name} ({left_ml:.0f} ml, {told}) was left out: {why}")
    labels = Volume(data, ct.lps_from_index)
    warnings = left_out + _warnings(ct, labels, anatomy, volume_ml, confidence, hips)
    jointed = [f"{bone}_{side}" for side in hips for bone in ("hip", "femur") if side in femora]
    heads = fitted_heads(labels, {name: 1 + anatomy.bone_names.index(name) for name in jointed})
    warnings += [told for side, head in heads.items() for told in doubted_radius(side, head.radius_mm)]
    warnings += doubted_slices(heads.values(), labels.spacing_mm)
    return Segmentation(labels, confidence, volume_ml, tuple(warnings), heads)


def _is_there(volume_ml: dict[str, float], doubtful: list[str], bone: str, least_ml: float) -> bool:
    return volume_ml.get(bone, 0.0) >= least_ml and bone not in doubtful


def _confidence(shares: Tensor, number: int) -> float:
    inside = shares.argmax(0) == number
    return float(shares[number][inside].mean()) if bool(inside.any()) else 0.0


def _sides_told_apart(shares: Tensor, network: BoneNetwork) -> Tensor:
    """The shares, with each connected femur, or hip bone that is mostly of one side, wholly of that side."""
    names = network.anatomy.bone_names
    coarse = shares.argmax(0).numpy()
    result = shares.clone()
    for bone in ("femur", "hip"):
        left, right = (1 + names.index(f"{bone}_{side}") for side in ("left", "right"))
        parts, count = ndimage.label((coarse == left) | (coarse == right))
        for part in range(1, count + 1):
            inside = parts == part
            share = float((coarse[inside] == left).mean())
            if 0 < share < 1 and max(share, 1 - share) >= _SIDE_SHARE[bone]:
                keep, drop = (left, right) if share > 0.5 else (right, left)
                near = torch.from_numpy(ndimage.binary_dilation(inside))
                result[keep][near] += result[drop][near]
                result[drop][near] = 0
    return result


def _spine_apart(shares: Tensor, network: BoneNetwork) -> Tensor:
    """The shares, with what is called a femur above the hip bones given to the vertebrae.

    No crop that the network learned from reaches far above the pelvis, and there it takes vertebrae for shafts.
    """
    names = network.anatomy.bone_names
    coarse = shares.argmax(0).numpy()
    hips = (coarse == 1 + names.index("hip_left")) | (coarse == 1 + names.index("hip_right"))
    parts, count = ndimage.label(hips)
    if not count:
        return shares
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    main = (sizes > _MAIN_PART * sizes.max())[parts]
    top = 1 + int(np.flatnonzero(main.any((1, 2))).max())
    result = shares.clone()
    for side in ("left", "right"):
        femur = 1 + names.index(f"femur_{side}")
        result[1 + names.index("vertebrae"), top:] += result[femur, top:]
        result[femur, top:] = 0
    return result


def _warnings(
    ct: Volume,
    labels: Volume,
    anatomy: Anatomy,
    volume_ml: dict[str, float],
    confidence: dict[str, float],
    hips: list[str],
) -> list[str]:
    names = anatomy.bone_names
    ids = {name: 1 + names.index(name) for name in volume_ml}
    told = cut_bones(labels, ids, list(ids), round_field(ct))
    if len(hips) == 1:
        other = "right" if hips == ["left"] else "left"
        told.append(f"the {other} hip bone is not in the CT: one half of the pelvis is missing")
    metal = float((ct.data > _METAL_HU).sum()) * float(np.prod(ct.spacing_mm)) / 1000
    if metal > _METAL_ML:
        told.append(f"{metal:.1f} ml of metal: look at the bones around it")
    data, hu, spacing = labels.data.numpy(), ct.data.numpy(), np.array(ct.spacing_mm)
    for side in ("left", "right"):
        femur, hip = f"femur_{side}", f"hip_{side}"
        if {femur, hip} <= set(ids):
            closed = closed_joint_mm2(data, hu, ids[femur], ids[hip], spacing)
            if closed > _CLOSED_MM2:
                told.append(f"{femur} and {hip}: no joint space is to be seen over {closed:.0f} mm²")
    told += [
        f"{name}: the network is not sure (mean probability {share:.2f})"
        for name, share in confidence.items()
        if share < _DOUBTED
    ]
    centres = {name: _middle_x(labels, ids[name]) for name in ids if name.endswith(("left", "right"))}
    for bone in ("hip", "femur"):
        pair = [centres.get(f"{bone}_{side}") for side in ("left", "right")]
        if pair[0] is not None and pair[1] is not None and pair[0] < pair[1]:
            told.append(f"{bone}_left lies to the right of {bone}_right: is the CT mirrored?")
    return told


def _middle_x(labels: Volume, number: int) -> float:
    """Mean x of a label, mm LPS."""
    index = torch.nonzero(labels.data == number).double().mean(0).flip(0)
    affine = labels.lps_from_index
    return float((affine[:3, :3] @ index + affine[:3, 3])[0])
