"""Femora of the two real CTs among the data, cut out by threshold: the one place where grey values of bone are real.

The CTs (STS_020, STS_044 of theibsi/data_sets, CC BY 3.0) come without labels. Bone is what is brighter than 180 HU;
what tells the femur from the pelvis is a sphere around its head and boxes beside it, read off the pictures by eye.
Good to about a voxel (1 × 1 × 3.3 mm): enough for a plan that is compared with itself, no segmentation of a reader.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder, write_text
from femoreg_torch.volume import Volume, read_ct, write_landmarks, write_volume

_BONE_HU = 180
_CLOSING, _OPENING = 3, 2  # voxels within a slice
_LABELS = {"left": (1, 5), "right": (2, 6)}  # hip bone and femur, as in the table `femoreg`


@dataclass(frozen=True)
class RealFemur:
    """What was read off the pictures of one CT. Voxels are (x, y, z); boxes are (x, y, z) from and to."""

    file: str
    side: Side
    head: tuple[float, float, float]  # centre
    radius_mm: float
    pelvis: tuple[tuple[tuple[int, int], tuple[int, int], tuple[int, int]], ...]  # boxes that are none of the femur's

    def near(self, shape: tuple[int, int, int], spacing: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Voxels (X, Y, Z) of the head."""
        index = np.ogrid[tuple(slice(n) for n in shape)]
        square = sum(((i - c) * h) ** 2 for i, c, h in zip(index, self.head, spacing, strict=True))
        return np.asarray(square <= self.radius_mm**2)


_ALL = (0, 999)
REAL_FEMORA = {
    "sts_044": RealFemur(
        "ct/ibsi_sts_044.nii.gz", "right", (107, 103, 41), 24.4,
        ((_ALL, _ALL, (44, 999)), ((112, 999), _ALL, _ALL), ((93, 999), (111, 999), _ALL)),
    ),
    "sts_020": RealFemur(
        "ct/ibsi_sts_020.nii.gz", "left", (60.5, 243, 79), 20.9,
        (
            (_ALL, _ALL, (82, 999)), ((0, 50), _ALL, _ALL), ((0, 72), (262, 999), _ALL), ((0, 66), _ALL, (0, 74)),
            ((0, 80), (0, 226), (75, 999)),
        ),
    ),
}  # fmt: skip


def cut_out_femur(hu: NDArray, spacing: NDArray[np.float64], known: RealFemur) -> NDArray[np.bool_]:
    """The femur (X, Y, Z) in grey values (X, Y, Z)."""
    x, y, z = hu.shape
    head = known.near((x, y, z), spacing)
    allowed = np.ones(hu.shape, bool)
    for box in known.pelvis:
        allowed[tuple(slice(low, high) for low, high in box)] = False
    allowed |= head
    bone = ((hu > _BONE_HU) & allowed) | head
    slices = []
    for n in range(z):
        closed = ndimage.binary_closing(np.pad(bone[:, :, n], 2 * _CLOSING), _disc(_CLOSING))
        inner = closed[2 * _CLOSING : -2 * _CLOSING, 2 * _CLOSING : -2 * _CLOSING] & allowed[:, :, n]
        slices.append(ndimage.binary_opening(ndimage.binary_fill_holes(inner), _disc(_OPENING)))
    pieces, _ = ndimage.label(np.stack(slices, axis=2))
    return np.asarray(pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax()))


def _disc(radius: int) -> NDArray[np.bool_]:
    line = np.arange(-radius, radius + 1)
    return np.asarray(np.hypot(line[:, None], line) <= radius + 0.3)


def write_real_femur(name: str, data: Path, out: Path) -> None:
    """Write a case with a real CT, its femur (and what else is bone, as hip bone), and the centre of the head.

    Raises `InputError` if the CT is not in the folder `data`.
    """
    known = REAL_FEMORA[name]
    if not (data / known.file).is_file():
        raise InputError(f"{data / known.file}: there is no such file. Set FEMOREG_DATA to the folder of the real CTs.")
    ct = read_ct(data / known.file)
    affine = ct.lps_from_index.numpy()
    hu = ct.data.numpy().transpose(2, 1, 0)
    femur = cut_out_femur(hu, np.linalg.norm(affine[:3, :3], axis=0), known)
    hip, number = _LABELS[known.side]
    labels = np.where(femur, number, np.where(hu > _BONE_HU, hip, 0)).astype(np.uint8)
    head = affine[:3, :3] @ np.array(known.head) + affine[:3, 3]
    points = np.argwhere(femur)
    lateral = points[points[:, 0].argmax() if known.side == "left" else points[:, 0].argmin()]
    entry = (affine[:3, :3] @ lateral + affine[:3, 3]).round(1).tolist()
    with new_folder(out) as folder:
        write_volume(folder / "ct.nii.gz", ct)
        label_data = torch.from_numpy(np.ascontiguousarray(labels.transpose(2, 1, 0)))
        write_volume(folder / "labels.nii.gz", Volume(label_data, ct.lps_from_index))
        write_landmarks(folder / "landmarks.json", {f"FH-{known.side[0]}": torch.from_numpy(head)})
        bones = f"{{hip_{known.side}: {hip}, femur_{known.side}: {number}}}"
        write_text(
            folder / "case.yaml",
            f"version: 2\ntemplate: femoroplasty\nside: {known.side}\n"
            f"ct: {{image: ct.nii.gz, labels: labels.nii.gz, bones: {bones}}}\nlandmarks: landmarks.json\n"
            f"plan: {{entry_point: {entry}, target: FH}}\ncarm: cios_fusion\n",
        )
