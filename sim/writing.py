"""Folders that the simulator writes: a patient, and a complete case with its images. Whole or not at all."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from femoreg_torch.case import Case, View, new_folder, read_case, write_case
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import write_image
from femoreg_torch.volume import read_ct, read_labels, read_mesh, write_landmarks, write_volume
from sim.acquisition import draw_procedure, load_settings
from sim.imaging import ViewImages, simulate_images
from sim.patient import make_patient
from sim.skeleton import read_skeleton

SIMULATION_STEPS = 6  # reports of `write_simulation`: poses, femur, three views, writing
_PREVIEW_PX = 512


def write_phantom(out: Path, seed: int, side: Side, spacing_mm: float) -> None:
    """Write the procedural patient of this seed as a case without images: CT, labels, landmarks, plan and device."""
    settings, _ = load_settings("paper")
    patient = make_patient(seed, spacing_mm)
    with new_folder(out) as folder:
        write_volume(folder / "ct.nii.gz", patient.ct.with_data(patient.ct.data.round().to(torch.int16)))
        write_volume(folder / "labels.nii.gz", patient.labels)
        write_landmarks(folder / "landmarks.json", patient.landmarks)
        write_case(folder, read_skeleton(folder, side, seed, settings, folder / "device.stl"))


def write_simulation(
    patient: Path, out: Path, seed: int, side: Side | None, config: str, report: Callable[[str], None]
) -> None:
    """Write the simulated acquisition of the patient in folder `patient` as a case in folder `out`.

    `side` is that of the patient's case.yaml, or left, where it is None; `config` is a preset or a YAML file. `report`
    is told each of `SIMULATION_STEPS` steps before it starts. Raises `InputError` before anything is written.
    """
    settings, model = load_settings(config)
    generator = torch.Generator().manual_seed(seed)
    side = side or (read_case(patient).side if (patient / "case.yaml").is_file() else "left")
    with new_folder(out) as folder:
        report("drawing the poses")
        skeleton = _copied(read_skeleton(patient, side, seed, settings, folder / "device.stl"), folder)
        assert skeleton.device is not None  # `_copied` has looked
        assert skeleton.labels_path is not None
        mesh = read_mesh(skeleton.device.model_path)
        procedure = draw_procedure(skeleton, mesh, settings, generator)
        ct = read_ct(skeleton.ct_path)
        images = simulate_images(
            ct,
            read_labels(skeleton.labels_path, ct),
            skeleton.structures[skeleton.femur],
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
