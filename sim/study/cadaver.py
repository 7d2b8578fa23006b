"""`python -m sim.study cadaver`: a simulated cadaver study, and what of its errors is the ground truth's own.

One computed specimen has seven beads in its femur and a device five on its surface. In every trial six images are made
with the beads in the beam, and a CT with the beads in the bone. Truths of three kinds are then held against each
registration:

- `measured`: all beads found in CT and images by `femoreg_torch.beads`, all views fitted at once;
- of some hands: the paper's way (section III-B), picked with the settings' noise in the first view alone;
- `exact`: what the simulation knows, which no cadaver study has.

The registration sees images and a CT from which the beads have been taken out (filled from around).
"""

import csv
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from femoreg_torch.configs import load_preset
from torch import Tensor

from femoreg_torch.beads import (
    Beads,
    Sight,
    bead_points,
    bundle,
    measure,
    metric_deviations,
    pose_uncertainty,
    read_beads,
    write_measured,
)
from femoreg_torch.case import RESULT_NAME, Case, new_folder, read_case, read_result
from femoreg_torch.case.femoroplasty import DEVICE, FEMUR
from femoreg_torch.case.model import Side
from femoreg_torch.commands.register import register_into
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors
from femoreg_torch.files import read_json, temporary_file, write_json, write_text
from femoreg_torch.geometry import Poses, project_points, transform_points
from femoreg_torch.settings import SEEDS, check_within, read_record
from femoreg_torch.statistics.formats import pipe_table, plus_minus
from femoreg_torch.statistics.quantities import METRICS, PAPER_TRIALS
from femoreg_torch.volume import Volume, read_ct, read_mesh, write_landmarks, write_volume
from sim.patient import make_scans
from sim.physics.line_integrals import together
from sim.theatre.beads import PlacedBeads, ct_with_beads, device_beads, femur_beads
from sim.theatre.case_folders import copied, write_images_and_case, write_patient_case
from sim.theatre.images import posed_tissue, view_images
from sim.theatre.metal import metal_in_beam
from sim.theatre.posed_tissue import areal_posed_tissue
from sim.theatre.preoperative_case import Preoperative, read_preoperative
from sim.theatre.procedure import draw_procedure
from sim.theatre.settings import load_simulation

MEASURED, EXACT = "measured", "exact"
NAMES = {quantity.column: quantity.label for quantity in METRICS}
_ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX", "X")
_BEADS_NAME, _PLACED_NAME, _RECORD_NAME = "beads.yaml", "placed_beads.json", "record.json"


@dataclass(frozen=True)
class FemurBeads:
    """Beads in the operated femur."""

    near_head: int
    near_entry_point: int
    diameter_mm: float
    seed: int

    def __post_init__(self) -> None:
        check_within(self, near_head=(0, 100), near_entry_point=(0, 100), diameter_mm=(0.1, 20), seed=SEEDS)


@dataclass(frozen=True)
class DeviceBeads:
    """Beads on the device."""

    count: int
    diameter_mm: float
    noise_mm: float

    def __post_init__(self) -> None:
        check_within(self, count=(1, 100), diameter_mm=(0.1, 20), noise_mm=(0, 10))


@dataclass(frozen=True)
class ByHand:
    """How well a person picks beads, standard deviations along each axis."""

    name: str
    image_noise_px: float
    bead_noise_mm: float

    def __post_init__(self) -> None:
        check_within(self, image_noise_px=(0, 100), bead_noise_mm=(0, 10))


@dataclass(frozen=True)
class CadaverStudy:
    """Settings; their meaning is told in `configs/study/cadaver.yaml`."""

    specimen: int
    side: Side
    trials: int
    first_seed: int
    acquisition: str
    preset: str
    voxels_mm: tuple[float, float]
    femur_beads: FemurBeads
    device_beads: DeviceBeads
    ct_blur_mm: float
    by_hand: list[ByHand]

    def __post_init__(self) -> None:
        if not 1 <= self.trials <= len(_ROMAN):
            raise InputError(f"trials: 1 to {len(_ROMAN)} were expected, found {self.trials}.")


def load_cadaver(name: str | Path) -> CadaverStudy:
    """Settings of a preset in `configs/study/` or of a YAML file. Raises `InputError` that names the key."""
    return read_record(CadaverStudy, load_preset("study", name), f"study {name}")


def make_trials(study: CadaverStudy, folder: Path, report: Callable[[str], None]) -> None:
    """Make the cases of all trials, with `beads.yaml` and where the beads truly are, unless they are there."""
    names = _ROMAN[: study.trials]
    if all((folder / name / _BEADS_NAME).is_file() for name in names):
        return
    held, imaged = make_scans(study.specimen, study.voxels_mm)
    with tempfile.TemporaryDirectory() as parent:
        specimen = Path(parent) / "specimen"
        write_patient_case(held, specimen, study.specimen, study.side)
        for number, name in enumerate(names):
            if not (folder / name / _BEADS_NAME).is_file():
                report(f"trial {name}: imaging")
                _make_trial(study, specimen, (imaged.ct, imaged.labels), folder / name, study.first_seed + number)


def _make_trial(study: CadaverStudy, specimen: Path, imaged: tuple[Volume, Volume], out: Path, seed: int) -> None:
    settings = load_simulation(study.acquisition)
    generator = torch.Generator().manual_seed(seed)
    with new_folder(out) as folder:
        known = copied(read_preoperative(specimen, study.side, seed, settings, folder / "device.stl"), folder)
        mesh = read_mesh(known.device.model.path)
        in_femur, on_device = place_beads(study, known, imaged[1])
        procedure = draw_procedure(known, mesh, settings.acquisition, generator)
        camera, step_mm = known.case.carm.camera, settings.acquisition.step_mm
        tissue = posed_tissue(*imaged, known.femur, known.head, procedure, camera)

        def body(pose: Tensor) -> dict[str, Tensor]:
            return together(
                areal_posed_tissue(tissue, pose, camera, step_mm), in_femur.areal(pose @ tissue.lps_from_femur, camera)
            )

        def fixed(camera_from_device: Tensor) -> Mapping[str, Tensor]:
            return on_device.areal(camera_from_device, camera)

        metal = metal_in_beam(mesh, study.specimen, settings.acquisition)
        images = view_images(body, metal, procedure, camera, settings.xray, generator, lambda _: None, on_device=fixed)
        known = _with_beaded_ct(known, in_femur, study.ct_blur_mm, folder)
        write_images_and_case(folder, known, images, procedure)
        noise = torch.randn(on_device.points.shape, generator=generator, dtype=torch.float64)
        picked = on_device.points + study.device_beads.noise_mm * noise
        named = {f"{DEVICE}{number}": point for number, point in enumerate(picked, 1)}
        write_landmarks(folder / "device_beads.mrk.json", named)
        write_json(folder / _PLACED_NAME, {FEMUR: in_femur.points, DEVICE: on_device.points})
        write_text(folder / _BEADS_NAME, _beads_text(study))


def place_beads(study: CadaverStudy, known: Preoperative, labels: Volume) -> tuple[PlacedBeads, PlacedBeads]:
    """Beads in the femur and on the device; the same in all trials of a study."""
    assert known.case.plan is not None  # the template has one
    wanted = study.femur_beads
    in_femur = femur_beads(
        labels,
        known.femur,
        known.head,
        known.case.plan.entry_point,
        (wanted.near_head, wanted.near_entry_point),
        wanted.diameter_mm,
        torch.Generator().manual_seed(wanted.seed),
    )
    mesh = read_mesh(known.device.model.path)
    return in_femur, device_beads(mesh, study.device_beads.count, study.device_beads.diameter_mm, wanted.seed)


def _with_beaded_ct(known: Preoperative, beads: PlacedBeads, blur_mm: float, folder: Path) -> Preoperative:
    beaded = ct_with_beads(read_ct(known.ct_path), beads, blur_mm)
    known.ct_path.unlink()  # a link to the specimen's
    write_volume(folder / "ct.nii.gz", beaded)
    path = folder / "ct.nii.gz"
    return replace(known, ct_path=path, case=replace(known.case, ct_path=path))


def _beads_text(study: CadaverStudy) -> str:
    femur, device = study.femur_beads, study.device_beads
    count = femur.near_head + femur.near_entry_point
    return (
        "objects:\n"
        f"  {FEMUR}: {{points: ct, count: {count}, diameter_mm: {femur.diameter_mm:g}}}\n"
        f"  {DEVICE}: {{points: device_beads.mrk.json, diameter_mm: {device.diameter_mm:g}, "
        f"noise_mm: {device.noise_mm:g}}}\n"
    )


def run_trial(study: CadaverStudy, case: Path, out: Path, number: int) -> dict[str, Any]:
    """One trial: beads measured, beads taken out, registered, and held against all three truths."""
    procedure = read_case(case)
    truth = procedure.truth
    assert truth is not None  # of a simulated case
    found = measure(procedure, read_beads(case / _BEADS_NAME, procedure))
    write_measured(out, procedure, found)
    run = out / "run"
    if not (run / RESULT_NAME).is_file():
        register_into(run, read_case(out), study.preset, number)
    result = read_result(run)
    points = bead_points(procedure, (FEMUR, DEVICE))
    own = metric_deviations(pose_uncertainty(found.bundle, points), found.bundle.poses, points)
    truths, deviations = {MEASURED: found.bundle.poses}, {MEASURED: own}
    for hand in study.by_hand:
        truths[hand.name], deviations[hand.name] = _by_hand(
            hand, procedure, read_json(case / _PLACED_NAME), found.beads, study.first_seed + number
        )
    told = list(truths)
    truths[EXACT], deviations[EXACT] = _without_pelvis(truth), dict.fromkeys(NAMES, 0.0)
    record = {
        "trusted": result.verdict.trusted,
        "shadow_noise_px": found.bundle.deviation_px,
        "shadows_used": int(found.bundle.used.sum()),
        "errors": {name: _metrics(errors(poses, result.poses, points)) for name, poses in truths.items()},
        "deviations": deviations,
        "truth_errors": {
            name: _truth_errors(errors(truths[EXACT].first_views(1), truths[name].first_views(1), points))
            for name in told
        },
        "bead_errors_mm": _bead_errors(read_json(case / _PLACED_NAME), found.beads),
    }
    write_json(out / _RECORD_NAME, record)
    return read_json(out / _RECORD_NAME)


def _without_pelvis(truth: Poses) -> Poses:
    return replace(truth, camera1_from={name: truth.camera1_from[name] for name in (FEMUR, DEVICE)})


def _metrics(found: dict[str, Any]) -> dict[str, float]:
    return {key: found[key] for key in NAMES}


def _truth_errors(found: dict[str, Any]) -> dict[str, Any]:
    """Of a truth against the exact one: each object's mm and degrees, and the paper's metrics."""
    rows: dict[str, Any] = {
        name: {key: found[name][key] for key in ("mm", "deg", "mm_xyz")} for name in (FEMUR, DEVICE)
    }
    return rows | _metrics(found)


def _bead_errors(placed: dict[str, Any], beads: Sequence[Beads]) -> dict[str, float]:
    """Root mean square distance of measured bead centres from where they truly are, by object."""
    rows = {}
    for thing in beads:
        apart = torch.cdist(thing.points, torch.tensor(placed[thing.object], dtype=torch.float64)).min(1).values
        rows[thing.object] = float((apart**2).mean().sqrt())
    return rows


def _by_hand(
    hand: ByHand, case: Case, placed: dict[str, Any], beads: Sequence[Beads], seed: int
) -> tuple[Poses, dict[str, float]]:
    """Poses from beads that a person has picked in CT and first view, and what they leave open of each metric."""
    assert case.truth is not None
    generator = torch.Generator().manual_seed(seed)
    camera = case.carm.camera
    picked, sights = [], []
    for thing in beads:
        true = torch.tensor(placed[thing.object], dtype=torch.float64)
        shift = hand.bead_noise_mm * torch.randn(true.shape, generator=generator, dtype=torch.float64)
        names = tuple(map(str, range(len(true))))
        noise = torch.full((len(true),), hand.bead_noise_mm, dtype=torch.float64)
        picked.append(Beads(thing.object, names, true + shift, thing.diameter_mm, noise))
        exact = project_points(camera, transform_points(case.truth.camera1_from[thing.object], true))
        seen = exact + hand.image_noise_px * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        sights += [Sight(thing.object, n, 0, "view 1", (c, r)) for n, (c, r) in enumerate(seen.tolist())]
    start = replace(_without_pelvis(case.truth), camera_from_camera1=torch.eye(4, dtype=torch.float64)[None])
    found = bundle(picked, sights, start, camera, hand.image_noise_px)
    points = bead_points(case, (FEMUR, DEVICE))
    return found.poses, metric_deviations(pose_uncertainty(found, points), found.poses, points)


def write_results(records: dict[str, dict[str, Any]], out: Path) -> str:
    """Write the rows as CSV; returns the tables as Markdown."""
    with temporary_file(out / "cadaver.csv") as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", "truth", "trusted", *NAMES, *(f"truth_{key}" for key in NAMES)])
        for name, record in records.items():
            for truth in record["errors"]:
                values = [record["errors"][truth][key] for key in NAMES]
                own = [record["deviations"][truth][key] for key in NAMES]
                writer.writerow([name, truth, int(record["trusted"]), *values, *own])
    text = "\n\n".join([_error_table(records), _truth_table(records)])
    write_text(out / "cadaver.md", text + "\n")
    return text


def _error_table(records: dict[str, dict[str, Any]]) -> str:
    rows = []
    for key, title in NAMES.items():
        for truth in next(iter(records.values()))["errors"]:
            values = [record["errors"][truth][key] for record in records.values()]
            own = math.sqrt(float(np.mean([record["deviations"][truth][key] ** 2 for record in records.values()])))
            told = "–" if truth == EXACT else f"{own:.2f}"
            label = f"{title}, truth: {truth}"
            rows.append([label, *(f"{value:.2f}" for value in values), _mean(values), told])
        paper = PAPER_TRIALS[key]
        shown = [f"{value:.2f}" for value in paper] if len(paper) == len(records) else [""] * len(records)
        rows.append([f"{title}, paper", *shown, _mean(paper), "–"])
    return pipe_table(["simulated trial", *records, "mean ± SD", "truth's own, rms"], rows)


def _truth_table(records: dict[str, dict[str, Any]]) -> str:
    rows = []
    for truth in next(iter(records.values()))["truth_errors"]:
        for name in (FEMUR, DEVICE):
            for unit, key in (("mm", "mm"), ("°", "deg")):
                values = [record["truth_errors"][truth][name][key] for record in records.values()]
                rows.append([f"{truth}: {name}, {unit}", *(f"{v:.2f}" for v in values), _mean(values)])
        for key, title in NAMES.items():
            values = [record["truth_errors"][truth][key] for record in records.values()]
            rows.append([f"{truth}: {title}", *(f"{v:.2f}" for v in values), _mean(values)])
    return pipe_table(["error of the truth itself", *records, "mean ± SD"], rows)


def _mean(values: list[float]) -> str:
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return plus_minus(float(np.mean(values)), deviation, 2)


def cadaver(settings: str = "cadaver", out: Path = Path("out/cadaver")) -> None:
    """Simulate the trials, measure their beads, register them, and print Table III beside the paper's.

    What is there already is kept.

    Args:
        settings: preset of configs/study, or a YAML file.
        out: folder of cases and results: OUT/trials and OUT/measured, cadaver.csv, cadaver.md.
    """
    study = load_cadaver(settings)
    make_trials(study, out / "trials", lambda step: print(step, flush=True))
    records = {}
    for number, name in enumerate(_ROMAN[: study.trials]):
        print(f"trial {name}: beads and registration", flush=True)
        records[name] = run_trial(study, out / "trials" / name, out / "measured" / name, number)
    print(write_results(records, out))
