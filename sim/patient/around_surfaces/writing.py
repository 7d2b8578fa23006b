"""A patient around bone surfaces as a folder."""

from dataclasses import asdict, replace
from pathlib import Path

from femoreg_torch.files import new_folder, write_json
from sim.patient.around_surfaces.scan import Options, patient_around
from sim.patient.around_surfaces.surfaces import read_surfaces
from sim.patient.writing import ORIGIN_NAME, write_patient


def write_patient_around(surfaces: Path, out: Path, options: Options) -> None:
    """Write the patient around the surfaces of an `.npz` file as folder `out`, whole or not at all.

    It holds ct.nii.gz, labels.nii.gz and landmarks.json (to 0.01 mm), and origin.json: subject, options, source,
    licence and role of the surfaces, which a volume made from them keeps. Raises `InputError` for a file that does not
    fit.
    """
    subject = read_surfaces(surfaces)
    patient = patient_around(subject, options)
    rounded = {name: point.round(decimals=2) for name, point in patient.landmarks.items()}
    with new_folder(out) as folder:
        write_patient(folder, replace(patient, landmarks=rounded))
        write_json(
            folder / ORIGIN_NAME,
            {
                "subject": subject.name,
                **asdict(options),
                "what": "synthetic CT: real bone shape and position, invented HU and soft tissue",
                "source": subject.source,
                "licence": subject.licence,
                "role": subject.role,
            },
        )
