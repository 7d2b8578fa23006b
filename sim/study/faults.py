"""Cases that are wrong in a way which nothing contradicts.

Mirrored patients, views and devices, a view told three times, the CT of somebody else, a femur that has broken since
the CT, a device that is bent.

A registration of such a case is not to be trusted, and should say so.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
import torch
import yaml
from scipy import ndimage
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.case.femoroplasty import DEVICE, femoral_head, operated_femur
from femoreg_torch.files import read_json, write_json, write_text
from femoreg_torch.geometry import about_point, exp_so3, rigid, transform_points
from femoreg_torch.text import read_yaml
from femoreg_torch.volume import Volume, read_ct, read_labels, read_landmarks, read_mesh, write_landmarks, write_volume
from sim.patient import make_patient, write_patient

_SOMEBODY_ELSE = 990001  # seed of a patient that no study images
_BREAK_MM, _BREAK_DEG = 32.0, 20.0  # where the neck breaks, from the centre of the head, and how far the head turns
_SOFT_TISSUE_HU = 40.0
_BEND_MM, _SLIGHT_BEND_MM = 12.0, 6.0  # at 100 mm from the base: the tip is then told some 5 mm, or 2 mm, wrongly
_KINK_DEG = 5.0  # of the front half against the rear one
_ASIDE_MM, _BELOW_MM = 8.0, 80.0  # how far the shaft lies aside, from so far below the centre of the head on
_LABELS = "femoreg"  # the table of the ids in these cases


def mirror_patient(folder: Path) -> None:
    """Mirror CT, label map and landmarks left to right, with the names of sides.

    The entry point lies as far from the head of the femur that is now on the operated side.
    """
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    ids = label_table(_LABELS)
    other_side = np.arange(256, dtype=np.uint8)
    for bone in HIP.bones:
        for own, other in zip(ids.get(bone.name, ()), ids.get(bone.mirror, ()), strict=True):
            other_side[own] = other
    write_volume(folder / "ct.nii.gz", _mirrored(ct))
    swapped = torch.from_numpy(other_side[labels.data.numpy().astype(np.uint8)])
    write_volume(folder / "labels.nii.gz", _mirrored(labels.with_data(swapped)))
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    before = read_landmarks(folder / "landmarks.json")
    names = {landmark.name: landmark.mirror for landmark in HIP.landmarks}
    after = {names[name]: mirror * point for name, point in before.items()}
    write_landmarks(folder / "landmarks.json", after)
    _keep_entry_point(folder, before, after)


def _keep_entry_point(folder: Path, before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> None:
    """Let the entry point lie as far from the operated femoral head as before."""
    content = read_case_file(folder)
    head = femoral_head(content["side"])
    entry = torch.tensor(content["plan"]["entry_point"], dtype=torch.float64) - before[head] + after[head]
    write_case_file(folder, content | {"plan": content["plan"] | {"entry_point": entry.tolist()}})


def mirror_second_view(folder: Path) -> None:
    """Mirror both images of the second view left to right."""
    for path in _images(folder)[1]:
        image = sitk.ReadImage(str(path))
        sitk.WriteImage(
            sitk.GetImageFromArray(np.ascontiguousarray(sitk.GetArrayFromImage(image)[..., ::-1])), str(path)
        )


def repeat_first_view(folder: Path) -> None:
    """Put the images of the first view in place of the others; the truth is that of three equal views."""
    first, *others = _images(folder)
    for view in others:
        for path, source in zip(view, first, strict=True):
            path.write_bytes(source.read_bytes())
    truth: dict[str, Any] = read_json(folder / "truth.json")
    poses = truth["camera_from_pelvis"]
    write_json(folder / "truth.json", truth | {"camera_from_pelvis": [poses[0]] * len(poses)})


def mirror_device(folder: Path) -> None:
    """Mirror the device's surface at a plane through its axis."""
    path = folder / f"{DEVICE}.stl"
    mesh = read_mesh(path)
    mesh.apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))
    mesh.export(path)


def take_another_patient(folder: Path) -> None:
    """Put CT, label map and landmarks of another patient in place of the right ones; the entry point as mirrored ones.

    The truth tells poses of a patient that the case does not have: errors against it say nothing.
    """
    ct = read_ct(folder / "ct.nii.gz")
    before = read_landmarks(folder / "landmarks.json")
    write_patient(folder, make_patient(_SOMEBODY_ELSE, min(max(ct.spacing_mm[0], 0.5), 2.0)))
    _keep_entry_point(folder, before, read_landmarks(folder / "landmarks.json"))


def break_femur(folder: Path) -> None:
    """Turn head and neck of the operated femur in CT and label map, about the head, and leave the shaft.

    The truth is that of the shaft, with the entry point.
    """
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    content = read_case_file(folder)
    head = read_landmarks(folder / "landmarks.json")[femoral_head(content["side"])]
    (bone,) = label_table(_LABELS)[operated_femur(content["side"])]
    axis = head - torch.tensor(content["plan"]["entry_point"], dtype=torch.float64)
    axis = axis / axis.norm()

    femur = labels.data.numpy() == bone
    index = np.argwhere(femur)[:, ::-1]
    points = transform_points(labels.lps_from_index, torch.from_numpy(index.copy()).double())
    proximal = np.zeros_like(femur)
    above = ((points - head) @ axis > -_BREAK_MM).numpy()
    proximal[tuple(index[above][:, ::-1].T)] = True

    # Each voxel takes what lies at its place turned back.
    about_ap = torch.tensor([0.0, math.radians(_BREAK_DEG), 0.0], dtype=torch.float64)
    back = torch.linalg.inv(ct.lps_from_index) @ about_point(rigid(exp_so3(-about_ap)), head) @ ct.lps_from_index
    matrix, shift = back[:3, :3].flip(0, 1).numpy(), back[:3, 3].flip(0).numpy()
    hu = ct.data.numpy().astype(np.float32)
    turned = ndimage.affine_transform(proximal.astype(np.float32), matrix, shift, order=1) > 0.5
    moved_hu = ndimage.affine_transform(hu, matrix, shift, order=1)
    others = (labels.data.numpy() > 0) & ~femur
    turned &= ~others
    new_hu = np.where(turned, moved_hu, np.where(proximal, np.float32(_SOFT_TISSUE_HU), hu))
    new_labels = np.where(turned, bone, np.where(proximal, 0, labels.data.numpy())).astype(np.uint8)
    write_volume(folder / "ct.nii.gz", ct.with_data(torch.from_numpy(new_hu.round().astype(np.int16))))
    write_volume(folder / "labels.nii.gz", labels.with_data(torch.from_numpy(new_labels)))


def bend_device(folder: Path, by_mm: float = _BEND_MM) -> None:
    """Bend the device's surface across its guide, by so much at 100 mm from its base; the named points stay."""
    path = folder / f"{DEVICE}.stl"
    mesh = read_mesh(path)
    vertices = mesh.vertices.copy()
    vertices[:, 1] += by_mm * (vertices[:, 2] / 100) ** 2
    mesh.vertices = vertices
    mesh.export(path)


def kink_device(folder: Path) -> None:
    """Turn the front half of the device's surface about where it meets the rear half; the named points stay."""
    path = folder / f"{DEVICE}.stl"
    mesh = read_mesh(path)
    (_, _, low), (_, _, high) = mesh.bounds
    middle = np.array([0.0, 0.0, (low + high) / 2])
    vertices = mesh.vertices.copy()
    front = vertices[:, 2] > middle[2]
    turn = exp_so3(torch.tensor([math.radians(_KINK_DEG), 0.0, 0.0], dtype=torch.float64)).numpy()
    vertices[front] = (vertices[front] - middle) @ turn.T + middle
    mesh.vertices = vertices
    mesh.export(path)


def shift_shaft(folder: Path) -> None:
    """Move the shaft of the operated femur to the patient's left in CT and label map, as if it had broken.

    The truth is that of head and trochanter, with the entry point.
    """
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    content = read_case_file(folder)
    head = read_landmarks(folder / "landmarks.json")[femoral_head(content["side"])]
    (bone,) = label_table(_LABELS)[operated_femur(content["side"])]
    femur = labels.data.numpy() == bone
    index = torch.from_numpy(np.argwhere(femur)[:, ::-1].copy()).double()
    below = (transform_points(labels.lps_from_index, index)[:, 2] < head[2] - _BELOW_MM).numpy()
    shaft = np.zeros_like(femur)
    shaft[tuple(np.argwhere(femur)[below].T)] = True

    voxels = (torch.linalg.inv(ct.lps_from_index[:3, :3]) @ torch.tensor([_ASIDE_MM, 0.0, 0.0]).double()).round().int()
    move = tuple(voxels.flip(0).tolist())
    hu = ct.data.numpy().astype(np.float32)
    moved, moved_hu = np.roll(shaft, move, (0, 1, 2)), np.roll(hu, move, (0, 1, 2))
    new_hu = np.where(moved, moved_hu, np.where(shaft, np.float32(_SOFT_TISSUE_HU), hu))
    new_labels = np.where(moved, bone, np.where(shaft, 0, labels.data.numpy())).astype(np.uint8)
    write_volume(folder / "ct.nii.gz", ct.with_data(torch.from_numpy(new_hu.round().astype(np.int16))))
    write_volume(folder / "labels.nii.gz", labels.with_data(torch.from_numpy(new_labels)))


FAULTS: dict[str, Callable[[Path], None]] = {
    "mirrored patient": mirror_patient,
    "mirrored view": mirror_second_view,
    "repeated view": repeat_first_view,
    "mirrored device": mirror_device,
    "another patient": take_another_patient,
    "fractured femur": break_femur,
    "bent device": bend_device,
    "shaft aside": shift_shaft,
    "kinked device": kink_device,
    "slightly bent device": partial(bend_device, by_mm=_SLIGHT_BEND_MM),
}


def read_case_file(folder: Path) -> dict[str, Any]:
    """The content of the case.yaml in a folder."""
    return read_yaml(folder / "case.yaml")


def write_case_file(folder: Path, content: dict[str, Any]) -> None:
    """Write the case.yaml of a folder."""
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    write_text(folder / "case.yaml", text)


def _images(folder: Path) -> list[list[Path]]:
    """The files of every view: the image of the anatomy, and that with the device."""
    return [
        [folder / view[kind] for kind in ("anatomy", DEVICE) if kind in view]
        for view in read_case_file(folder)["views"]
    ]


def _mirrored(volume: Volume) -> Volume:
    """A volume whose axes are those of the patient, mirrored at x = 0."""
    affine = volume.lps_from_index.clone()
    affine[0, 3] = -(affine[0, 3] + affine[0, 0] * (volume.data.shape[2] - 1))
    return Volume(volume.data.flip(2).contiguous(), affine)
