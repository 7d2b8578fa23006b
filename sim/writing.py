"""Folders that the simulator writes: a patient, and a complete case with its images. Whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from femoreg_torch.case import Case, View, new_folder, read_case, write_case
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import write_image
from femoreg_torch.volume import Volume, read_ct, read_labels, read_mesh, write_landmarks, write_volume
from femoreg_torch.volume.labels import label_box_centre
from sim.acquisition import draw_procedure, load_settings
from sim.imaging import ViewImages, simulate_images
from sim.patient import Patient, make_patient, make_scans
from sim.skeleton import read_skeleton

SIMULATION_STEPS = 6  # reports of `write_simulation`: poses, femur, three views, writing
_PREVIEW_PX = 512
_SAME_MM = 2.0  # two scans of one patient agree within a voxel or two


def write_phantom(out: Path, seed: int, side: Side, spacing_mm: float) -> None:
    """Write the procedural patient of this seed as a case without images: CT, labels, landmarks, plan and device."""
    _write_patient(make_patient(seed, spacing_mm), out, seed, side)


def _write_patient(patient: Patient, out: Path, seed: int, side: Side) -> None:
    settings, _ = load_settings("paper")
    with new_folder(out) as folder:
        write_volume(folder / "ct.nii.gz", patient.ct.with_data(patient.ct.data.round().to(torch.int16)))
        write_volume(folder / "labels.nii.gz", patient.labels)
        write_landmarks(folder / "landmarks.json", patient.landmarks)
        write_case(folder, read_skeleton(folder, side, seed, settings, folder / "device.stl"))


def write_simulation(
    patient: Path,
    out: Path,
    seed: int,
    side: Side | None,
    config: str,
    report: Callable[[str], None],
    finer: Path | None = None,
) -> None:
    """Write the simulated acquisition of the patient in folder `patient` as a case in folder `out`.

    `side` is that of the patient's case.yaml, or left, where it is None; `config` is a preset or a YAML file. `report`
    is told each of `SIMULATION_STEPS` steps before it starts. `finer` is a folder with ct.nii.gz and labels.nii.gz of
    the same patient on finer voxels, if there is one: the images are then made from it, while the case holds the CT of
    `patient`. Raises `InputError` before anything is written.
    """
    side = side or (read_case(patient).side if (patient / "case.yaml").is_file() else "left")
    _write_simulation(patient, out, seed, side, config, report, None if finer is None else partial(_read_pair, finer))


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
        _write_patient(held, patient, patient_seed, side)
        _write_simulation(patient, out, seed, side, config, report, lambda: (imaged.ct, imaged.labels))


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
) -> None:
    settings, model = load_settings(config)
    generator = torch.Generator().manual_seed(seed)
    with new_folder(out) as folder:
        report("drawing the poses")
        skeleton = _copied(read_skeleton(patient, side, seed, settings, folder / "device.stl"), folder)
        assert skeleton.device is not None  # `_copied` has looked
        assert skeleton.labels_path is not None
        mesh = read_mesh(skeleton.device.model_path)
        procedure = draw_procedure(skeleton, mesh, settings, generator)
        ct = read_ct(skeleton.ct_path)
        labels = read_labels(skeleton.labels_path, ct)
        femur = skeleton.structures[skeleton.femur]
        if imaged is not None:
            finer_ct, finer_labels = imaged()
            _check_same_patient(labels, finer_labels, femur)
            ct, labels = finer_ct, finer_labels
        images = simulate_images(
            ct,
            labels,
            femur,
            skeleton.femoral_head,
            mesh,
            procedure,
            skeleton.carm.camera,
            settings,
            model,
            generator,
            report,
        )
        report("writing")
        views = []
        for number, view in enumerate(images, 1):
            views.append(View(folder / f"view{number}.tif", folder / f"view{number}_device.tif"))
            write_image(views[-1].anatomy, view.anatomy)
            write_image(folder / f"view{number}_device.tif", view.device)
        write_preview(folder / "preview.png", images)
        write_case(folder, replace(skeleton, views=tuple(views), truth=procedure.truth))


def _check_same_patient(labels: Volume, finer: Volume, femur: tuple[int, ...]) -> None:
    """Raises `InputError` unless both label maps have the femur in the same place."""
    apart = (label_box_centre(labels, femur) - label_box_centre(finer, femur)).norm().item()
    if apart > _SAME_MM:
        raise InputError(
            f"simulation: the femur lies {apart:.1f} mm elsewhere in the finer CT than in the one of the case. "
            "Give two scans of one patient in the same frame."
        )


def _copied(skeleton: Case, folder: Path) -> Case:
    """The skeleton with its volumes and its device in `folder`; volumes are linked where the file system can."""
    if skeleton.labels_path is None or skeleton.device is None:
        raise InputError(f"{skeleton.folder}: a label map is needed to turn the femur. Add `ct.labels` to case.yaml.")
    ct_path, labels_path = (_linked(path, folder) for path in (skeleton.ct_path, skeleton.labels_path))
    model_path = folder / f"device{skeleton.device.model_path.suffix}"
    if skeleton.device.model_path != model_path:
        shutil.copyfile(skeleton.device.model_path, model_path)
    device = replace(skeleton.device, model_path=model_path)
    return replace(skeleton, folder=folder, ct_path=ct_path, labels_path=labels_path, device=device)


def _linked(path: Path, folder: Path) -> Path:
    target = folder / path.name
    if path.is_dir():
        shutil.copytree(path, target)
        return target
    try:
        os.link(path, target)
    except OSError:  # another file system, or one without hard links
        shutil.copyfile(path, target)
    return target


def write_preview(path: Path, images: list[ViewImages]) -> None:
    """One picture of all images as a monitor shows them (bone dark): a column per view, anatomy above device."""
    rows = [np.hstack([_shown(getattr(view, name)) for view in images]) for name in ("anatomy", "device")]
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise OSError(f"{path}: the preview could not be written.")


def _shown(raw: torch.Tensor) -> np.ndarray:
    """An 8-bit picture of a raw image (H, W): small, logarithmic, windowed to what lies behind the patient."""
    small = cv2.resize(raw.numpy(), (_PREVIEW_PX, _PREVIEW_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = np.log(small.clip(1))
    low, high = np.percentile(grey[grey < grey.max() - 2], [0.5, 95])
    return ((grey - low) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8)
