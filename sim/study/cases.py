"""The case folders of a study, made once and kept: the images depend on nothing but the procedure and the settings."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError
from femoreg_torch.files import plain, read_json, write_json
from sim.patient.around_surfaces import Options, write_patient_around
from sim.study.procedures import Procedure, Study
from sim.theatre.case_folders import write_procedural_simulation, write_simulation

# Voxels of the CT in the case, and of those that the images are made from.
REGISTERED_MM = 1.0
PROCEDURAL_IMAGED_MM = 0.75
REAL_IMAGED_MM = 0.5
_ORIGIN = "study.json"


@dataclass(frozen=True)
class Stores:
    """Folders that a study reads from and writes to."""

    cases: Path
    patients: Path  # CTs built around real bone shapes
    data: Path  # `meshes/SUBJECT.npz` of the real bones

    def case(self, procedure: Procedure) -> Path:
        """Where the case of a procedure stands."""
        return self.cases / procedure.name


def ready(procedure: Procedure, study: Study, stores: Stores) -> bool:
    """Whether the case of a procedure is there. Raises `InputError` if it was made with other settings."""
    path = stores.case(procedure) / _ORIGIN
    if not path.is_file():
        return False
    if read_json(path) != _origin(procedure, study):
        raise InputError(f"{path.parent}: was made with other settings than those of this study. Remove it.")
    return True


def _origin(procedure: Procedure, study: Study) -> dict[str, Any]:
    settings = load_preset("simulation", study.acquisition)
    voxels = (REGISTERED_MM, PROCEDURAL_IMAGED_MM if procedure.procedural else REAL_IMAGED_MM)
    return plain({"procedure": asdict(procedure), "voxels_mm": voxels, "simulation": settings})


def make_case(procedure: Procedure, study: Study, stores: Stores, report: Callable[[str], None]) -> None:
    """Make the case of a procedure, unless it is there."""
    if ready(procedure, study, stores):
        return
    folder, origin = stores.case(procedure), _origin(procedure, study)
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted run left
    stores.cases.mkdir(parents=True, exist_ok=True)
    if procedure.procedural:
        spacings = (REGISTERED_MM, PROCEDURAL_IMAGED_MM)
        patient = int(procedure.patient)
        write_procedural_simulation(folder, patient, procedure.seed, procedure.hip, study.acquisition, report, spacings)
    else:
        patient_folder, finer = (
            subject_folder(procedure.patient, mm, stores) for mm in (REGISTERED_MM, REAL_IMAGED_MM)
        )
        write_simulation(patient_folder, folder, procedure.seed, procedure.hip, study.acquisition, report, finer)
    write_json(folder / _ORIGIN, origin)


def make_case_alone(procedure: Procedure, study: Study, stores: Stores) -> None:
    """The same in a process of its own, on one core and without a word."""
    torch.set_num_threads(1)
    make_case(procedure, study, stores, lambda _: None)


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
