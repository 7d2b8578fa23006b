"""The patients that a network learns from, rendered once into a cache of labelled views."""

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from femoreg_torch.case import case_folder
from femoreg_torch.detect import network_camera
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import clear_leftovers
from femoreg_torch.geometry import load_carm
from femoreg_torch.settings import SEEDS, check_within
from femoreg_torch.tensors import read_metadata
from femoreg_torch.text import json_content
from sim.labelled.attenuation_layers import Layers, deform, smooth_displacement, split_layers
from sim.labelled.layer_landmarks import landmarks_by_rule
from sim.labelled.patient_folders import PatientFiles, find_patient, hip_labels, read_patient
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
        if both := sorted(set(self.patient_seeds) & set(self.validation_seeds)):
            raise InputError(
                f"cohort: patient {both[0]} is among patient_seeds and validation_seeds. Whom it learns from cannot "
                "tell how well it does."
            )


@dataclass(frozen=True)
class Source:
    """One patient to be rendered: who it is in messages and in the cache, and how it is made."""

    name: str
    file: str  # what its files in the cache are called, but for the variant
    told: dict[str, str]  # in the metadata of these files, beside the settings
    variants: int
    load: Callable[[], Layers]


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

    `cases` are folders as `sim.labelled.patient_folders` reads them, or their `case.yaml`; those whose files have
    changed since are rendered anew, and so are procedural patients whose CT has another voxel size. Raises `InputError`
    if two cases have one name, there is no patient to learn from, or the cache holds views made with other settings.
    """
    cases = [case_folder(case) for case in cases]
    _check_names(cases)
    if not cases and not settings.patient_seeds:
        raise InputError(
            "training: there is no patient to learn from. Give folders by --cases, or procedural patients by "
            "cohort.patient_seeds in the settings."
        )
    given = [_of_case(case, settings, report) for case in cases]  # complains before anything is rendered
    cache.mkdir(parents=True, exist_ok=True)
    clear_leftovers(cache)
    training: list[Path] = []
    for source in [*given, *(_procedural(seed, settings) for seed in settings.patient_seeds)]:
        training += _variants(settings, cache, source, report)
    validation: list[Path] = []
    for seed in settings.validation_seeds:
        validation += _variants(settings, cache, _procedural(seed, settings), report)
    devices = None
    if settings.devices:
        camera = network_camera(load_carm(settings.carm).camera)
        devices = render_devices(cache / "devices.safetensors", settings.devices, camera, settings.seed)
    return Cohort(training, validation, devices)


def _check_names(cases: Sequence[Path]) -> None:
    """Raises `InputError` for two folders of one name, by which their views are told apart."""
    known: dict[str, Path] = {}
    for case in cases:
        name = case.resolve().name
        if name in known:
            raise InputError(
                f"--cases: {known[name]} and {case} have one name, {shortened(name)}, by which rendered views are told "
                "apart. Rename one of the folders, or give it once."
            )
        known[name] = case


def _of_case(folder: Path, settings: CohortSettings, report: Callable[[str], None]) -> Source:
    files = find_patient(folder)
    name = files.folder.resolve().name
    told = {"case": name, "files": files.fingerprint()}
    return Source(name, f"case_{name}", told, settings.case_variants, partial(_read_case, name, files, report))


def _procedural(seed: int, settings: CohortSettings) -> Source:
    name = f"patient{seed}"
    make = partial(_make_patient, seed, settings.patient_spacing_mm)
    told = {"patient": name, "spacing_mm": f"{settings.patient_spacing_mm:g}"}
    return Source(name, name, told, settings.patient_variants, make)


def _read_case(name: str, files: PatientFiles, report: Callable[[str], None]) -> Layers:
    patient = read_patient(files)
    for note in patient.bones.notes:
        report(f"{name}: {note}")
    try:
        return split_layers(patient.ct, hip_labels(patient.bones), patient.landmarks)
    except InputError as error:
        raise InputError(f"{files.folder}: {error}") from error


def _make_patient(seed: int, spacing_mm: float) -> Layers:
    patient = make_patient(seed, spacing_mm)
    return split_layers(patient.ct, patient.labels, patient.landmarks)


def _variants(settings: CohortSettings, cache: Path, source: Source, report: Callable[[str], None]) -> list[Path]:
    """The files of all variants of one patient, rendered where they are missing or of another CT than it has now."""
    files = [cache / f"{source.file}_{variant:02d}.safetensors" for variant in range(source.variants)]
    how = {key: value for key, value in asdict(settings).items() if key in _RENDERED}
    written = json.dumps({**source.told, **how})
    missing = [n for n, file in enumerate(files) if not (file.exists() and _is_of(file, source.told, how))]
    if not missing:
        return files
    layers = source.load()
    camera = network_camera(load_carm(settings.carm).camera)
    for variant in missing:
        rng = np.random.default_rng([settings.seed, zlib.crc32(source.name.encode()), variant])
        patient = deform(layers, smooth_displacement(rng, settings.deformation_mm)) if variant else layers
        if settings.landmarks == "rules":
            patient = replace(patient, landmarks=landmarks_by_rule(patient))
        again = " anew" if files[variant].exists() else ""
        write_views(files[variant], patient, settings.ranges, camera, settings.views, rng, written)
        report(f"rendered {settings.views} views of {source.name}{again}, variant {variant + 1} of {source.variants}")
    return files


def _is_of(file: Path, told: dict[str, str], how: dict[str, Any]) -> bool:
    """Whether cached views are of the patient as it is now. Raises `InputError` if their settings are others."""
    found = read_metadata(file).get("source", "{}")
    about = json_content(found, f"{file}, source")
    expected = json.loads(json.dumps({**told, **how}))
    if about == expected:
        return True
    if not isinstance(about, dict) or {key: about.get(key) for key in how} != {key: expected[key] for key in how}:
        raise InputError(
            f"{file}: rendered with other settings ({shortened(found, 300)}). Choose an empty cache folder."
        )
    return False
