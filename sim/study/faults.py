"""Cases that are wrong in a way which nothing contradicts: mirrored patients, views, devices, a view told three times.

A registration of such a case cannot be right, and must say so.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
import torch
import yaml

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.case.femoroplasty import DEVICE, femoral_head
from femoreg_torch.files import read_json, write_json, write_text
from femoreg_torch.volume import Volume, read_ct, read_labels, read_landmarks, read_mesh, write_landmarks, write_volume

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


FAULTS: dict[str, Callable[[Path], None]] = {
    "mirrored patient": mirror_patient,
    "mirrored view": mirror_second_view,
    "repeated view": repeat_first_view,
    "mirrored device": mirror_device,
}


def read_case_file(folder: Path) -> dict[str, Any]:
    """The content of the case.yaml in a folder."""
    content: dict[str, Any] = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    return content


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
