"""Folders that the simulator writes: a patient, and a complete case with its images. Whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from femoreg_torch.case import View, new_folder, read_case, write_case
from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, DEVICE_IMAGES, with_device
from femoreg_torch.case.model import PlannedPath, Side
from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.report.planning import FIGURES
from femoreg_torch.fluoro import write_image
from femoreg_torch.volume import Volume, label_box_centre, read_ct, read_label_map, read_labels, read_mesh
from sim.patient import Patient, make_patient, make_scans, write_patient
from sim.theatre.images import ViewImages, simulate_images
from sim.theatre.metal import metal_in_beam
from sim.theatre.preoperative_case import Preoperative, read_preoperative
from sim.theatre.preview import write_preview
from sim.theatre.procedure import Procedure, draw_procedure
from sim.theatre.settings import load_simulation

SIMULATION_STEPS = 6  # reports of `write_simulation`: poses, femur, three views, writing
_SAME_MM = 2.0  # two scans of one patient agree within a voxel or two


def write_phantom(out: Path, seed: int, side: Side, spacing_mm: float) -> None:
    """Write the procedural patient of this seed as a case without images: CT, labels, landmarks, plan and device."""
    write_patient_case(make_patient(seed, spacing_mm), out, seed, side)


def write_patient_case(patient: Patient, out: Path, seed: int, side: Side) -> None:
    """Write a patient as a case without images, with a plan for this side and the device of this seed."""
    with new_folder(out) as folder:
        write_patient(folder, patient)
        known = read_preoperative(folder, side, seed, load_simulation("paper"), folder / "device.stl")
        write_case(folder, known.case)


def write_simulation(
    patient: Path,
    out: Path,
    seed: int,
    side: Side | None,
    config: str,
    report: Callable[[str], None],
    finer: Path | None = None,
    device: torch.device = CPU,
) -> None:
    """Write the simulated acquisition of the patient in folder `patient` as a case in folder `out`.

    `side` is that of the patient's case.yaml, or left, where it is None; `config` is a preset or a YAML file. `report`
    is told each of `SIMULATION_STEPS` steps before it starts. `finer` is a folder with ct.nii.gz and labels.nii.gz of
    the same patient on finer voxels, if there is one: the images are then made from it, while the case holds the CT of
    `patient`. Rays are cast on `device`. Raises `InputError` before anything is written.
    """
    known = read_case(patient).side if side is None and (patient / "case.yaml").is_file() else side
    scan = None if finer is None else partial(_read_pair, finer)
    _write_simulation(patient, out, seed, known or "left", config, report, scan, seed, device)


def write_procedural_simulation(
    out: Path,
    patient_seed: int,
    seed: int,
    side: Side,
    config: str,
    report: Callable[[str], None],
    spacings_mm: tuple[float, float] = (1.0, 0.75),
) -> None:
    """Write the simulated acquisition of a procedural patient as a case in folder `out`.

    `spacings_mm` are the voxels of the CT in the case, and of the one that the images are made from; both show the
    patient of `patient_seed`. The rest is as in `write_simulation`.
    """
    held, imaged = make_scans(patient_seed, spacings_mm)
    with tempfile.TemporaryDirectory() as parent:
        patient = Path(parent) / "patient"
        write_patient_case(held, patient, patient_seed, side)
        _write_simulation(patient, out, seed, side, config, report, lambda: (imaged.ct, imaged.labels), patient_seed)


def _case_scan(known: Preoperative) -> tuple[Volume, Volume]:
    ct = read_ct(known.ct_path)
    return ct, read_labels(known.labels_path, ct)


def _read_pair(folder: Path) -> tuple[Volume, Volume]:
    ct = read_ct(folder / "ct.nii.gz")
    return ct, read_labels(folder / "labels.nii.gz", ct)


def _write_simulation(
    patient: Path,
    out: Path,
    seed: int,
    side: Side,
    config: str,
    report: Callable[[str], None],
    imaged: Callable[[], tuple[Volume, Volume]] | None,
    device_seed: int,
    device: torch.device = CPU,
) -> None:
    settings = load_simulation(config)
    generator = torch.Generator().manual_seed(seed)
    with new_folder(out) as folder:
        report("drawing the poses")
        given = read_preoperative(patient, side, seed, settings, folder / "device.stl")
        known = copied(given, folder)
        mesh = read_mesh(given.device.model.path)
        procedure = draw_procedure(known, mesh, settings.acquisition, generator)
        ct, labels = _case_scan(given) if imaged is None else imaged()  # complaints are to name the files given
        if imaged is not None:
            check_same_patient(read_label_map(known.labels_path), labels, known.femur)
        images = simulate_images(
            ct,
            labels,
            known.femur,
            known.head,
            metal_in_beam(mesh, device_seed, settings.acquisition),
            procedure,
            known.case.carm.camera,
            settings.acquisition,
            settings.xray,
            generator,
            report,
            device,
        )
        report("writing")
        write_images_and_case(folder, known, images, procedure)


def write_images_and_case(folder: Path, known: Preoperative, images: list[ViewImages], procedure: Procedure) -> None:
    """Write the images of a procedure, a preview of them, and the case with its truth into its folder."""
    views = []
    for number, view in enumerate(images, 1):
        paths = {
            ANATOMY_IMAGES: folder / f"view{number}.tif",
            DEVICE_IMAGES: folder / f"view{number}_device.tif",
        }
        write_image(paths[ANATOMY_IMAGES], view.anatomy)
        write_image(paths[DEVICE_IMAGES], view.device)
        views.append(View(paths))
    write_preview(folder / "preview.png", images, known.case.carm.camera)
    write_case(folder, replace(known.case, views=tuple(views), truth=procedure.truth, truth_source="simulation"))


def check_same_patient(labels: Volume, finer: Volume, femur: tuple[int, ...]) -> None:
    """Raises `InputError` unless both label maps have the femur in the same place."""
    apart = (label_box_centre(labels, femur) - label_box_centre(finer, femur)).norm().item()
    if apart > _SAME_MM:
        raise InputError(
            f"simulation: the femur lies {apart:.1f} mm elsewhere in the finer CT than in the one of the case. "
            "Give two scans of one patient in the same frame."
        )


def copied(known: Preoperative, folder: Path) -> Preoperative:
    """The same with volumes, device and the file of its plan in `folder`; volumes are linked where that can be done."""
    ct_path, labels_path = (_linked(path, folder) for path in (known.ct_path, known.labels_path))
    model_path = folder / f"device{known.device.model.path.suffix}"
    if known.device.model.path != model_path:
        shutil.copyfile(known.device.model.path, model_path)
    device = replace(known.device, model=replace(known.device.model, path=model_path))
    plan = _plan_copied(known.case.plan, folder / "plan")
    case = replace(with_device(known.case, device), folder=folder, ct_path=ct_path, labels_path=labels_path, plan=plan)
    return replace(known, case=case, ct_path=ct_path, labels_path=labels_path, device=device)


def _plan_copied(plan: PlannedPath | None, folder: Path) -> PlannedPath | None:
    """The same with the plan.json that it is from, and the pictures that a report shows of it, in a new `folder`."""
    if plan is None or plan.file is None:
        return plan
    folder.mkdir()
    for name in (plan.file.name, *(name for name, _ in FIGURES)):
        if (plan.file.parent / name).is_file():
            shutil.copyfile(plan.file.parent / name, folder / name)
    return replace(plan, file=folder / plan.file.name)


def _linked(path: Path, folder: Path) -> Path:
    target = folder / path.name
    if path.is_dir():
        shutil.copytree(path, target)
        return target
    try:
        os.link(path.resolve(), target)  # of a link, what it leads to
    except OSError:  # another file system, or one without hard links
        shutil.copyfile(path, target)
    return target
