"""Where a study keeps patients and cases, and the CTs around real bone shapes, which are made once."""

from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.errors import InputError
from sim.patient.around_surfaces import Options, write_patient_around

# Voxels of the CT in the case, and of those that the images are made from.
REGISTERED_MM = 1.0
PROCEDURAL_IMAGED_MM = 0.75
REAL_IMAGED_MM = 0.5


@dataclass(frozen=True)
class Stores:
    """Folders that a study reads from and writes to."""

    cases: Path
    patients: Path  # CTs built around real bone shapes
    data: Path  # `meshes/SUBJECT.npz` of the real bones


def subject_folder(subject: str, spacing_mm: float, stores: Stores) -> Path:
    """CT, labels and landmarks around the bones of a subject, made unless they are there.

    Raises `InputError` if the bones are missing.
    """
    folder = stores.patients / subject / f"{spacing_mm:.1f}"
    if folder.is_dir():
        return folder
    mesh = stores.data / "meshes" / f"{subject}.npz"
    if not mesh.is_file():
        raise InputError(
            f"{mesh}: there is no such file. Set FEMOREG_DATA to the folder of the real bone shapes, or measure on "
            "procedural patients only (--kind procedural)."
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    write_patient_around(mesh, folder, Options(spacing_mm=spacing_mm))
    return folder
