"""A case's CT made worse than the patient that was imaged: thick slices, another kernel, wrong HU, a poor label map.

Or its labels and landmarks are those that `femoreg segment` and `femoreg landmarks` find in it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.geometry import transform_points
from femoreg_torch.segment import load_bone_network, propose_landmarks, segment_bones
from femoreg_torch.settings import check_within
from femoreg_torch.volume import Volume, bone_labels, crop, read_ct, read_labels, write_landmarks, write_volume


@dataclass(frozen=True)
class ImperfectCt:
    """How the CT that a case holds differs from a perfect one."""

    slice_mm: float | None = None  # thickness of its slices: the nearest whole number of those that are there
    blur_mm: float = 0.0  # standard deviation of a softer reconstruction kernel
    hu_scale: float = 1.0
    grow_voxels: int = 0  # of every bone's labels, into what has none; negative: they shrink
    cut_mm: float | None = None  # the scan ends so far below the head of the operated femur
    found_labels: bool = False  # the label map is the one that is found in the CT
    found_landmarks: bool = False  # and so are the landmarks

    def __post_init__(self) -> None:
        check_within(
            self, slice_mm=(0.1, 50), blur_mm=(0, 50), hu_scale=(0.01, 100), grow_voxels=(-50, 50), cut_mm=(-500, 1000)
        )


def spoil_ct(folder: Path, head: Tensor, change: ImperfectCt) -> None:
    """Change CT, label map and landmarks in a case folder; `head` (3,) is the centre of the femoral head, LPS mm.

    Raises `InputError` if bones or landmarks are to be found and the CT shows none.
    """
    ct_path, labels_path = folder / "ct.nii.gz", folder / "labels.nii.gz"
    ct = read_ct(ct_path)
    labels = read_labels(labels_path, ct)
    ct, labels = (_cut(volume, head, change.cut_mm) for volume in (ct, labels))
    data = ct.data.numpy().astype(np.float32)
    if change.blur_mm:
        data = ndimage.gaussian_filter(data, [change.blur_mm / s for s in reversed(ct.spacing_mm)])
    ct = ct.with_data(torch.from_numpy(data * np.float32(change.hu_scale)))
    labels = labels.with_data(torch.from_numpy(grown(labels.data.numpy(), change.grow_voxels)))
    if change.slice_mm is not None:
        ct, labels = thick_slices(ct, change.slice_mm, mean=True), thick_slices(labels, change.slice_mm, mean=False)
    ct = ct.with_data(ct.data.round())
    if change.found_labels:
        labels = segment_bones(ct, load_bone_network()).labels
    if change.found_landmarks:
        bones = bone_labels(labels, ct, label_table("femoreg"), HIP, {})
        write_landmarks(folder / "landmarks.json", propose_landmarks(ct, bones).points)
    write_volume(ct_path, ct.with_data(ct.data.to(torch.int16)))
    write_volume(labels_path, labels)


def thick_slices(volume: Volume, slice_mm: float, mean: bool) -> Volume:
    """The volume in slices of `slice_mm` along its last axis: means of the thinner ones, or the middle one of each.

    A thick slice is the nearest whole number of thin ones; those that fill none are left out.
    """
    count = max(1, round(slice_mm / volume.spacing_mm[2]))
    whole = len(volume.data) // count
    stacks = volume.data[: whole * count].unflatten(0, (whole, count))
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += (count - 1) / 2 * affine[:3, 2]
    affine[:3, 2] *= count
    return Volume(stacks.float().mean(1) if mean else stacks[:, count // 2].contiguous(), affine)


def grown(labels: np.ndarray, voxels: int) -> np.ndarray:
    """A label map (Z, Y, X) whose regions are so many voxels larger, where nothing else is; smaller if negative."""
    cross = ndimage.generate_binary_structure(3, 1)
    for _ in range(abs(voxels)):
        largest = ndimage.grey_dilation(labels, footprint=cross)
        if voxels > 0:
            labels = np.where(labels == 0, largest, labels)
        else:
            smallest = ndimage.grey_erosion(labels, footprint=cross)
            labels = np.where(largest == smallest, labels, np.zeros_like(labels))
    return labels


def _cut(volume: Volume, head: Tensor, below_mm: float | None) -> Volume:
    """The volume without what lies more than `below_mm` below a point (3,), LPS mm; z runs upwards in it."""
    if below_mm is None:
        return volume
    lowest = head - torch.tensor([0, 0, below_mm], dtype=head.dtype)
    index = transform_points(torch.linalg.inv(volume.lps_from_index), lowest[None].double())[0]
    width, height, depth = reversed(volume.data.shape)
    return crop(volume, (0, 0, max(0, int(index[2]))), (width, height, depth))
