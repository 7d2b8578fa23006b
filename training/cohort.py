"""The patients that a network learns from, rendered once into a cache of labelled views."""

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import network_camera
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import clear_leftovers
from femoreg_torch.geometry import load_carm
from femoreg_torch.settings import SEEDS, check_within
from femoreg_torch.tensors import read_metadata
from femoreg_torch.volume import read_ct, read_labels, read_landmarks
from sim.labelled.attenuation_layers import Layers, deform, smooth_displacement, split_layers
from sim.labelled.layer_landmarks import landmarks_by_rule
from sim.labelled.training_views import write_views
from sim.labelled.view_poses import ViewRanges
from sim.patient import make_patient
from training.devices import render_devices

_RENDERED = ("views", "deformation_mm", "carm", "seed", "ranges", "landmarks")  # settings that change what is rendered


@dataclass(frozen=True)
class CohortSettings:
    """Who is rendered, how often and how."""

    patient_seeds: list[int]  # procedural patients to train on
    validation_seeds: list[int]  # procedural patients that only early stopping and the learning curve see
    patient_spacing_mm: float = 1.5
    patient_variants: int = 4  # smooth deformations of each procedural patient, the patient itself being the first
    case_variants: int = 30  # and of each case folder given
    views: int = 40  # per variant
    deformation_mm: float = 4.0  # standard deviation of the displacement along each axis
    carm: str = "cios_fusion"
    seed: int = 1
    landmarks: Literal["carried", "rules"] = "carried"  # of a variant: moved with the bone, or found on it anew
    devices: int = 0  # images of devices to lay over the views
    ranges: ViewRanges = field(default_factory=ViewRanges)

    def __post_init__(self) -> None:
        check_within(
            self,
            patient_seeds=SEEDS,
            validation_seeds=SEEDS,
            patient_spacing_mm=(0.3, 5),
            patient_variants=(1, 10_000),
            case_variants=(1, 10_000),
            views=(1, 100_000),
            deformation_mm=(0, 50),
            seed=SEEDS,
            devices=(0, 100_000),
        )


@dataclass(frozen=True)
class Cohort:
    """Files of labelled views, and one of device shadows if any were asked for."""

    training: list[Path]
    validation: list[Path]
    devices: Path | None


def render_cohort(
    settings: CohortSettings, cases: Sequence[Path], cache: Path, report: Callable[[str], None]
) -> Cohort:
    """The views to train on and to validate on, rendered into `cache` unless they are there.

    `cases` are folders with ct.nii.gz, labels.nii.gz and landmarks.json. Raises `InputError` if the cache holds views
    made with other settings.
    """
    cache.mkdir(parents=True, exist_ok=True)
    clear_leftovers(cache)
    training: list[Path] = []
    for case in cases:
        name = case.resolve().name
        training += _variants(settings, cache, name, settings.case_variants, partial(_read_case, case), report)
    for seed in settings.patient_seeds:
        make = partial(_make_patient, seed, settings.patient_spacing_mm)
        training += _variants(settings, cache, f"patient{seed}", settings.patient_variants, make, report)
    validation: list[Path] = []
    for seed in settings.validation_seeds:
        make = partial(_make_patient, seed, settings.patient_spacing_mm)
        validation += _variants(settings, cache, f"patient{seed}", settings.patient_variants, make, report)
    devices = None
    if settings.devices:
        camera = network_camera(load_carm(settings.carm).camera)
        devices = render_devices(cache / "devices.safetensors", settings.devices, camera, settings.seed)
    return Cohort(training, validation, devices)


def _read_case(folder: Path) -> Layers:
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    landmarks = read_landmarks(folder / "landmarks.json")
    if missing := [name for name in HIP.landmark_names if name not in landmarks]:
        raise InputError(
            f"{folder / 'landmarks.json'}: to train, all {len(HIP.landmarks)} landmarks are needed, {len(missing)} are "
            f"missing: {', '.join(missing)}."
        )
    return split_layers(ct, labels, landmarks)


def _make_patient(seed: int, spacing_mm: float) -> Layers:
    patient = make_patient(seed, spacing_mm)
    return split_layers(patient.ct, patient.labels, patient.landmarks)


def _variants(
    settings: CohortSettings,
    cache: Path,
    name: str,
    count: int,
    load: Callable[[], Layers],
    report: Callable[[str], None],
) -> list[Path]:
    files = [cache / f"{name}_{variant:02d}.safetensors" for variant in range(count)]
    how = {k: v for k, v in asdict(settings).items() if k in _RENDERED}
    source = json.dumps({"patient": name, **how})
    for file in files:
        if file.exists():
            _check_source(file, source)
    missing = [variant for variant, file in enumerate(files) if not file.exists()]
    if not missing:
        return files
    layers = load()
    camera = network_camera(load_carm(settings.carm).camera)
    for variant in missing:
        rng = np.random.default_rng([settings.seed, zlib.crc32(name.encode()), variant])
        patient = deform(layers, smooth_displacement(rng, settings.deformation_mm)) if variant else layers
        if settings.landmarks == "rules":
            patient = replace(patient, landmarks=landmarks_by_rule(patient))
        write_views(files[variant], patient, settings.ranges, camera, settings.views, rng, source)
        report(f"rendered {settings.views} views of {name}, variant {variant + 1} of {count}")
    return files


def _check_source(file: Path, source: str) -> None:
    found = read_metadata(file).get("source")
    if found != source:
        raise InputError(
            f"{file}: rendered with other settings ({shortened(found, 300)}). Choose an empty cache folder."
        )
