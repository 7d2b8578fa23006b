"""Simulated images in the layout of the public DeepFluoro data set, so that what reads the one reads the other.

The layout is that of its preprocessed files, `ipcai_2020_ds_8x.h5` and so on (README of
rg2/DeepFluoroLabeling-IPCAI2020):

    land-names/num-lands      14
    land-names/land-00 …      names, in the order of the anatomy's
    NN/projs  (N, R, C) float32    attenuation, bone bright, head up; 01, 02, … are the patients
    NN/segs   (N, R, C) uint8      labels 0 to 6
    NN/lands  (N, 2, 14) float32   columns, then rows; may lie outside of the image

There, images lose 50 pixels at each border and then keep every s-th point: pixel u of a file is pixel 50 + s u of the
detector, without the half pixel by which an average over s × s pixels would be moved.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from femoreg_torch.configs import load_preset

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro import attenuation_image
from femoreg_torch.geometry import Camera, load_carm
from femoreg_torch.settings import SEEDS, check_within, read_record
from sim.labelled.devices_in_view import make_devices
from sim.labelled.imaged_patient import ImagedPatient, prepare_patient, read_imaged_patient
from sim.labelled.physics_views import render_physics
from sim.labelled.settings import LabelledSettings
from sim.patient import make_patient

_BORDER_PX = 50  # of the detector, cut off on every side
_COMPRESSION = 9  # of gzip, as in the public files


@dataclass(frozen=True)
class Cohort:
    """Who is imaged, and how often."""

    seeds: tuple[int, ...]  # procedural patients
    spacing_mm: float  # of their CTs
    folders: tuple[str, ...]  # of patients, see `sim.labelled.patient_folders`
    views: int  # of each patient
    seed: int

    def __post_init__(self) -> None:
        check_within(self, seeds=SEEDS, spacing_mm=(0.3, 5), views=(1, 100_000), seed=SEEDS)


@dataclass(frozen=True, kw_only=True)
class DatasetSettings(LabelledSettings):
    """Settings of a data set; their meaning is told in `configs/simulation/deepfluoro.yaml`."""

    patients: Cohort


def deepfluoro_camera(camera: Camera, factor: int) -> Camera:
    """The camera of the file's images: every `factor`-th pixel between the borders that are cut off."""
    rows, columns = (round((n - 2 * _BORDER_PX) / factor) for n in camera.shape)
    if min(rows, columns) < 1:
        raise InputError(f"image, binning: {factor} leaves no pixel of a {camera.shape} detector.")
    spans = [slice(_BORDER_PX, _BORDER_PX + (n - 1) * factor + 1, factor) for n in (rows, columns)]
    return camera.window(*spans)


def load_dataset_settings(config: str | Path) -> DatasetSettings:
    """Settings of a preset in `configs/simulation/` or of a YAML file. Raises `InputError` that names the key."""
    return read_record(DatasetSettings, load_preset("simulation", config), f"labelled images {config}")


def write_dataset(config: str, out: Path, report: Callable[[str], None]) -> None:
    """Render the data set of a preset or YAML file into the HDF5 file `out`, whole or not at all.

    `report` is told each patient before it is imaged. Raises `InputError` for settings that do not fit.
    """
    where = f"labelled images {config}"
    settings = load_dataset_settings(config)
    cohort = settings.patients
    camera = deepfluoro_camera(load_carm(settings.carm).camera, settings.image.binning)
    sources: list[tuple[str, Callable[[], ImagedPatient]]] = [
        (f"procedural patient {seed}", partial(_procedural, seed, cohort.spacing_mm)) for seed in cohort.seeds
    ]
    sources += [(folder, partial(read_imaged_patient, Path(folder))) for folder in cohort.folders]
    if not sources:
        raise InputError(f"{where}, patients: neither `seeds` nor `folders` name a patient.")
    with temporary_file(out) as part, h5py.File(part, "w") as file:
        _write_names(file)
        for number, (source, make) in enumerate(sources, 1):
            report(source)
            seed = (cohort.seed, number)
            _write_patient(file.create_group(f"{number:02d}"), make(), settings, camera, cohort.views, seed, source)


def _procedural(seed: int, spacing_mm: float) -> ImagedPatient:
    patient = make_patient(seed, spacing_mm)
    return prepare_patient(patient.ct, patient.labels, patient.landmarks)


def _write_names(file: h5py.File) -> None:
    names = file.create_group("land-names")
    names["num-lands"] = len(HIP.landmark_names)
    for n, name in enumerate(HIP.landmark_names):
        names[f"land-{n:02d}"] = name


def _write_patient(
    group: h5py.Group,
    patient: ImagedPatient,
    settings: LabelledSettings,
    camera: Camera,
    count: int,
    seed: tuple[int, int],
    source: str,
) -> None:
    """Render and write view by view, so that no more than one is held."""
    group.attrs["source"] = f"simulated: {source}"
    options: Mapping[str, Any] = {"compression": "gzip", "compression_opts": _COMPRESSION}
    shape, one = (count, *camera.shape), (1, *camera.shape)
    projs = group.create_dataset("projs", shape, np.float32, chunks=one, **options)
    segs = group.create_dataset("segs", shape, np.uint8, chunks=one, **options)
    lands = group.create_dataset("lands", (count, 2, len(HIP.landmark_names)), np.float32)
    rng = np.random.default_rng(seed)
    noise = torch.Generator().manual_seed(int(rng.integers(2**62)))
    devices = make_devices(settings)
    for n in range(count):
        view = render_physics(patient, settings, camera, camera, devices, rng, noise)
        image, labels, landmarks = attenuation_image(view.image.float()), view.labels, view.landmarks
        if view.pose.mirrored:  # for display
            image, labels, landmarks = image.flip(-1), labels.flip(-1), landmarks.clone()
            landmarks[:, 0] = camera.shape[1] - 1 - landmarks[:, 0]
        projs[n], segs[n], lands[n] = image.numpy(), labels.numpy(), landmarks.T.numpy()
