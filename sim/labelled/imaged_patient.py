"""A patient made ready for labelled images: densities and bone masks."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.volume import Volume, resample_isotropic
from sim.labelled.patient_folders import find_patient, hip_labels, read_patient
from sim.labelled.prolonged import prolonged
from sim.labelled.view_poses import FEMORAL_HEADS
from sim.physics.tissue_densities import separate

MASK_MM = 1.5  # voxels of the masks, and step of the path lengths in them
_BEYOND_MM = 60.0  # of the first and the last slice repeated below and above the scan


@dataclass(frozen=True)
class ImagedPatient:
    """Densities in g/cm³ and masks by bone, all where the CT has them."""

    filled: Volume  # water, and κ times bone: see `sim.physics.tissue_densities`
    bone: Volume  # but for the femora
    femora: dict[str, Volume]  # density
    masks: dict[str, Volume]  # 1 inside the bone; a bone that the CT lacks is absent
    landmarks: Tensor  # (L, 3) LPS mm, in the order of the anatomy's


def prepare_patient(ct: Volume, labels: Volume, landmarks: Mapping[str, Tensor]) -> ImagedPatient:
    """The patient of a CT in HU and its label map (ids of the table `femoreg`) on the same grid; both femora apart.

    Raises `InputError` if the label map lacks a femur.
    """
    ct, labels = prolonged(ct, _BEYOND_MM), prolonged(labels, _BEYOND_MM)
    ids = label_table("femoreg")
    filled, bone, femora, _ = separate(ct, labels, [ids[femur] for femur in FEMORAL_HEADS])
    masks = {}
    for name in HIP.bone_names:
        inside = torch.isin(labels.data, torch.tensor(ids[name], dtype=labels.data.dtype))
        if inside.any():
            masks[name] = resample_isotropic(labels.with_data(inside.to(torch.float32)), MASK_MM)
    points = torch.stack([landmarks[name] for name in HIP.landmark_names])
    return ImagedPatient(filled, bone, dict(zip(FEMORAL_HEADS, femora, strict=True)), masks, points)


def read_imaged_patient(folder: Path) -> ImagedPatient:
    """The patient of a folder, see `sim.labelled.patient_folders`. Raises `InputError`."""
    patient = read_patient(find_patient(folder))
    return prepare_patient(patient.ct, hip_labels(patient.bones), patient.landmarks)
