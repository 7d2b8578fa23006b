"""The procedures of a study imaged again under other conditions: other devices, other X-rays, cases that tell less.

Almost all time goes into the patient's mass along the rays, which is the same under most conditions. It is kept, view
by view, so that each further condition costs a few seconds. Remove the folder of bodies when patients, or their line
integrals, have changed.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from femoreg_torch.configs import laid_over
from joblib import delayed
from torch import Tensor

from femoreg_torch.case import new_folder
from femoreg_torch.case.femoroplasty import DEVICE
from femoreg_torch.case.model import Case
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import plain, read_json, temporary_file, write_json
from femoreg_torch.fluoro import downsample
from femoreg_torch.geometry import Camera
from femoreg_torch.settings import check_within, read_record
from femoreg_torch.volume import Volume, read_ct, read_labels, read_mesh
from sim.patient import Patient, make_scans
from sim.study.cases import PROCEDURAL_IMAGED_MM, REAL_IMAGED_MM, REGISTERED_MM, Stores, subject_folder
from sim.study.code import digest
from sim.study.faults import FAULTS, read_case_file, write_case_file
from sim.study.imperfect_ct import ImperfectCt, spoil_ct
from sim.study.procedures import Procedure
from sim.study.processes import in_processes
from sim.theatre import procedure as theatre
from sim.theatre.case_folders import check_same_patient, copied, write_images_and_case, write_patient_case
from sim.theatre.device import make_device_parts
from sim.theatre.images import ViewImages, posed_tissue, view_images
from sim.theatre.metal import draw_materials, metal_in_beam
from sim.theatre.posed_tissue import PosedTissue, areal_posed_tissue
from sim.theatre.preoperative_case import Preoperative, read_preoperative
from sim.theatre.settings import Simulation

_ORIGIN = "study.json"


@dataclass(frozen=True)
class Told:
    """What a case says about what was imaged."""

    parts: bool = False  # the device's parts, each with its material; else one device of `device_hu`
    materials: dict[str, str] = field(default_factory=dict)  # told in place of the true ones
    device_images: bool = True
    sdd: float = 1.0  # distance from source to detector that is told, of the true one
    principal_point_px: float = 0.0  # by which its columns are told too high
    ct: ImperfectCt | None = None
    binned: int = 1  # so many rows and columns of the images averaged into one
    fault: str | None = None  # what is wrong with the case: a name of `sim.study.faults`

    def __post_init__(self) -> None:
        check_within(self, sdd=(0.1, 10), principal_point_px=(-5000, 5000), binned=(1, 64))


@dataclass(frozen=True)
class Condition:
    """Settings that are laid over those of a study, and what its cases say."""

    name: str
    acquisition: dict[str, Any] = field(default_factory=dict)
    xray: dict[str, Any] = field(default_factory=dict)
    told: Told = field(default_factory=Told)
    carm: str | None = None  # a preset or YAML file of another C-arm


@dataclass(frozen=True)
class Imaged:
    """Folders that conditions are written to."""

    bodies: Path | None  # what the patients' rays are kept in for later conditions, if they are to be kept
    conditions: Path

    def case(self, condition: Condition, procedure: Procedure) -> Path:
        """Where the case of a procedure under a condition stands."""
        return self.conditions / condition.name / procedure.name


def check_faults(condition: Condition, where: str) -> None:
    """Raises `InputError` if the cases of a condition are to be wrong in a way that is not known."""
    if condition.told.fault not in (None, *FAULTS):
        raise InputError(
            f"{where}: there is no fault {shortened(condition.told.fault)}; there are: {', '.join(FAULTS)}."
        )


def make_conditions(
    chosen: Sequence[Procedure],
    conditions: Sequence[Condition],
    base: dict[str, Any],
    stores: Stores,
    out: Imaged,
    jobs: int,
) -> None:
    """Make the cases that are not there yet, `jobs` procedures at a time and each on one core.

    `base` is the content of the `Simulation` that the conditions start from.
    """
    tasks = [delayed(_image_alone)(procedure, conditions, base, stores, out) for procedure in chosen]
    for _ in in_processes(jobs, tasks):
        pass


def _image_alone(
    procedure: Procedure, conditions: Sequence[Condition], base: dict[str, Any], stores: Stores, out: Imaged
) -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        body = body_of(procedure, stores, out, Path(scratch))
        for condition in conditions:
            made_once(condition, procedure, base, body, out)


def body_of(procedure: Procedure, stores: Stores, out: Imaged, scratch: Path) -> "Body":
    """The patient of a procedure; its rays are kept in `scratch` where they are not to be kept."""
    return Body(procedure, stores, scratch / "body" if out.bodies is None else out.bodies / procedure.name)


def made_once(condition: Condition, procedure: Procedure, base: dict[str, Any], body: "Body", out: Imaged) -> Path:
    """The case folder of a procedure under a condition; it is made unless it is there, by whichever code.

    Raises `InputError` if it was made with other settings.
    """
    folder = out.case(condition, procedure)
    if not is_made(condition, procedure, base, out):
        make_case(condition, procedure, base, body, folder)
    return folder


def is_made(condition: Condition, procedure: Procedure, base: dict[str, Any], out: Imaged) -> bool:
    """Whether a case is there. Raises `InputError` if it was made with other settings."""
    path = out.case(condition, procedure) / _ORIGIN
    if not path.is_file():
        return False
    if read_json(path) != _origin(condition, procedure, base):
        raise InputError(f"{path.parent}: was made with other settings than those of this condition. Remove it.")
    return True


def _origin(condition: Condition, procedure: Procedure, base: dict[str, Any]) -> dict[str, Any]:
    voxels = (REGISTERED_MM, _imaged_mm(procedure))
    usual = asdict(Told())
    said = {key: value for key, value in asdict(condition.told).items() if value != usual[key]}
    told = {"procedure": asdict(procedure), "voxels_mm": voxels, "told": said}
    return plain(told | {"simulation": simulation_of(condition, base)})


def simulation_of(condition: Condition, base: dict[str, Any]) -> dict[str, Any]:
    """What a condition makes of simulation settings: content of a `Simulation`."""
    change: dict[str, Any] = {"acquisition": condition.acquisition, "xray": condition.xray}
    change |= {} if condition.carm is None else {"carm": condition.carm}
    return laid_over(base, change, f"condition {condition.name}")


def _imaged_mm(procedure: Procedure) -> float:
    return PROCEDURAL_IMAGED_MM if procedure.procedural else REAL_IMAGED_MM


class Body:
    """The patient of a procedure: its folder, and its mass along the rays of any view, made once and kept on disk."""

    def __init__(self, procedure: Procedure, stores: Stores, folder: Path) -> None:
        self.procedure, self.stores, self.folder = procedure, stores, folder
        self._scans: tuple[Patient, Patient] | None = None
        self._tissue: tuple[str, PosedTissue] | None = None  # the last one, and what it depends on
        self._images: tuple[str, list[ViewImages]] | None = None  # the same

    @property
    def device_seed(self) -> int:
        """The seed of the device: that of a computed patient, or of the procedure."""
        return int(self.procedure.patient) if self.procedure.procedural else self.procedure.seed

    def patient(self) -> Path:
        """The folder of what is known before the operation; it is made if need be."""
        if not self.procedure.procedural:
            return subject_folder(self.procedure.patient, REGISTERED_MM, self.stores)
        folder = self.folder / "patient"
        if not folder.is_dir():
            write_patient_case(self._made()[0], folder, self.device_seed, self.procedure.hip)
        return folder

    def areal(
        self, pose: Tensor, known: Preoperative, drawn: theatre.Procedure, camera: Camera, step_mm: float
    ) -> dict[str, Tensor]:
        """Mass per area (H, W) in g/cm² of each material of the patient, seen from `camera_from_lps` (4, 4)."""
        key = digest(pose, drawn.femur_rotation, asdict(camera), step_mm, _imaged_mm(self.procedure))
        path = self.folder / f"{key}.pt"
        if path.is_file():
            found: dict[str, Tensor] = torch.load(path, weights_only=True)
            return found
        made = areal_posed_tissue(self._posed(known, drawn, camera), pose, camera, step_mm)
        self.folder.mkdir(parents=True, exist_ok=True)
        with temporary_file(path) as part:
            torch.save(made, part)
        return made

    def images(self, key: str, made: Callable[[], list[ViewImages]]) -> list[ViewImages]:
        """The last images if they were asked for by the same key, else new ones."""
        if self._images is None or self._images[0] != key:
            self._images = key, made()
        return self._images[1]

    def _posed(self, known: Preoperative, drawn: theatre.Procedure, camera: Camera) -> PosedTissue:
        key = digest(drawn.camera_from_pelvis, drawn.femur_rotation, asdict(camera))
        if self._tissue is None or self._tissue[0] != key:
            ct, labels = self.imaged(known)
            self._tissue = key, posed_tissue(ct, labels, known.femur, known.head, drawn, camera)
        return self._tissue[1]

    def imaged(self, known: Preoperative) -> tuple[Volume, Volume]:
        """The finer scan, in HU, and its labels."""
        if self.procedure.procedural:
            imaged = self._made()[1]
            return imaged.ct, imaged.labels
        folder = subject_folder(self.procedure.patient, REAL_IMAGED_MM, self.stores)
        ct = read_ct(folder / "ct.nii.gz")
        labels = read_labels(folder / "labels.nii.gz", ct)
        check_same_patient(read_labels(known.labels_path, read_ct(known.ct_path)), labels, known.femur)
        return ct, labels

    def _made(self) -> tuple[Patient, Patient]:
        if self._scans is None:
            held, imaged = make_scans(int(self.procedure.patient), (REGISTERED_MM, PROCEDURAL_IMAGED_MM))
            self._scans = held, imaged
        return self._scans


def make_case(
    condition: Condition, procedure: Procedure, base: dict[str, Any], body: Body, target: Path
) -> theatre.Procedure:
    """Write one case, and tell how it was drawn. With the settings `base` alone its images are theirs, bit for bit."""
    content = simulation_of(condition, base)
    settings = read_record(Simulation, content, f"condition {condition.name}")
    generator = torch.Generator().manual_seed(procedure.seed)
    patient = body.patient()
    with new_folder(target) as folder:
        known = read_preoperative(patient, procedure.hip, body.device_seed, settings, folder / f"{DEVICE}.stl")
        known = copied(known, folder)
        drawn = theatre.draw_procedure(known, read_mesh(known.device.model.path), settings.acquisition, generator)
        images = body.images(digest(content), lambda: image_views(body, known, drawn, settings, generator))
        write_told(folder, known, images, drawn, condition.told, body.device_seed)
        write_json(folder / _ORIGIN, _origin(condition, procedure, base))
    return drawn


def image_views(
    body: Body, known: Preoperative, drawn: theatre.Procedure, settings: Simulation, generator: torch.Generator
) -> list[ViewImages]:
    """The images of a procedure as it was drawn."""
    camera, step_mm = known.case.carm.camera, settings.acquisition.step_mm

    def areal(pose: Tensor) -> dict[str, Tensor]:
        return body.areal(pose, known, drawn, camera, step_mm)

    metal = metal_in_beam(read_mesh(known.device.model.path), body.device_seed, settings.acquisition)
    return view_images(areal, metal, drawn, camera, settings.xray, generator, lambda _: None)


def write_told(
    folder: Path,
    known: Preoperative,
    images: list[ViewImages],
    drawn: theatre.Procedure,
    told: Told,
    device_seed: int,
) -> None:
    """Write images and case into a folder that holds the patient; the case says what is told."""
    said = replace(known, case=_said(known.case, told))
    write_images_and_case(folder, said, [_binned(view, told.binned) for view in images], drawn)
    if not told.device_images:
        _without_device_images(folder)
    if told.parts:
        _name_parts(folder, device_seed, told.materials)
    if told.ct is not None:
        spoil_ct(folder, known.head, told.ct)
    if told.fault is not None:
        FAULTS[told.fault](folder)


def _said(case: Case, told: Told) -> Case:
    """The case with the C-arm that is told."""
    true = case.carm.camera
    column, row = true.principal_point_px
    shifted = (column + told.principal_point_px, row)
    camera = replace(true, sdd_mm=true.sdd_mm * told.sdd, principal_point_px=shifted)
    return replace(case, carm=replace(case.carm, camera=camera.downsampled(told.binned)))


def _binned(images: ViewImages, factor: int) -> ViewImages:
    """Images whose pixels are means of so many rows and columns."""
    if factor == 1:
        return images
    fewer = (downsample(image.float(), factor).round().to(image.dtype) for image in (images.anatomy, images.device))
    return ViewImages(*fewer)


def _without_device_images(folder: Path) -> None:
    """Leave only the images of the anatomy in a case; the device stays described."""
    content = read_case_file(folder)
    for view in content["views"]:
        (folder / view.pop(DEVICE)).unlink()
    write_case_file(folder, content)


def _name_parts(folder: Path, device_seed: int, told: dict[str, str]) -> None:
    """Write the parts of the device, and have the case name them, with their materials or with what is told of them."""
    materials = draw_materials(device_seed)
    parts = []
    for name, mesh in make_device_parts(device_seed).items():
        mesh.export(folder / f"{name}.stl")
        parts.append({"model": f"{name}.stl", "material": told.get(materials[name], materials[name])})
    content = read_case_file(folder)
    device = {key: value for key, value in content[DEVICE].items() if key not in ("model", "hu")}
    write_case_file(folder, content | {DEVICE: {"parts": parts} | device})
