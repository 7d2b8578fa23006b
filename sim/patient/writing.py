"""A patient as files."""

from pathlib import Path

import torch

from femoreg_torch.volume import write_landmarks, write_volume
from sim.patient.scan import Patient

ORIGIN_NAME = "origin.json"  # beside a patient: what it is made from, under which licence


def write_patient(folder: Path, patient: Patient) -> None:
    """Write ct.nii.gz (whole HU, int16), labels.nii.gz and landmarks.json into `folder`, which must exist."""
    write_volume(folder / "ct.nii.gz", patient.ct.with_data(patient.ct.data.round().to(torch.int16)))
    write_volume(folder / "labels.nii.gz", patient.labels)
    write_landmarks(folder / "landmarks.json", patient.landmarks)
