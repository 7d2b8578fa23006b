"""How far a study is from what its images allow: the Cramér–Rao bound of its procedures, made anew from their seeds.

What is written beside the runs of the study is read by `femoreg tables` and `femoreg report`: `bounds.parquet`, a row
for each bound of a procedure (`femoreg_torch.statistics.limit_tables` says what the columns are).
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch
import yaml
from torch import Tensor

from femoreg_torch.case import read_case
from femoreg_torch.case.femoroplasty import DEVICE, PELVIS
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors, reference_points
from femoreg_torch.files import plain, temporary_file, write_text
from femoreg_torch.geometry import CArm, Poses
from femoreg_torch.registration import Plan, Stage
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.settings import read_record
from femoreg_torch.statistics.limit_tables import (
    ALL_IMAGES,
    BOUND,
    BOUNDS_NAME,
    INFORMATION,
    NOISE,
    POSES_ALONE,
    REGISTERED,
    USUAL,
    first_views_name,
    without_name,
)
from femoreg_torch.statistics.rows import DONE
from femoreg_torch.statistics.study import read_study
from femoreg_torch.volume import read_mesh
from sim.physics.fluoroscopy import XrayModel, photons_per_pixel
from sim.study.cases import Stores
from sim.study.conditions import Body, make_case, simulation_of
from sim.study.exposures import (
    DISTANCE,
    Theatre,
    drawn_images,
    principal_block,
    simulated_images,
    with_noise,
)
from sim.study.information import Information, bound, known_before, shares_of_information
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, load_protocol
from sim.study.responses import error_responses, view_block
from sim.study.rows import flat_errors, read_table
from sim.study.work import Setting, settings_of
from sim.theatre.images import posed_tissue
from sim.theatre.metal import metal_in_beam
from sim.theatre.preoperative_case import read_preoperative
from sim.theatre.procedure import draw_procedure
from sim.theatre.settings import Simulation

Row = dict[str, Any]
PROCEDURAL = "procedural"  # kind of runs on computed patients
_SAME = ("study", "condition", "number", "settings")  # columns of a run that its bounds depend on

# What is unknown beside the poses: kinds of blocks.
_LIGHT = ("exposure", "scatter", "tissue")
_UNKNOWN: dict[str, tuple[str, ...]] = {
    POSES_ALONE: (),
    "+ light and tissue": _LIGHT,
    USUAL: (*_LIGHT, "density"),
    "+ densities and tissue's shape": (*_LIGHT, "density", "shape"),
    "+ densities and cameras": (*_LIGHT, "density", "camera"),
}
_CARM_KNOWN = "+ densities, C-arm known"


@dataclass(frozen=True, eq=False)
class Imagined:
    """A procedure of a study, and the informations of its images."""

    theatre: Theatre
    images: tuple[Information, ...]
    carm: CArm


def limits(
    protocol_name: str,
    study: Path,
    count: int,
    pixel_mm: float,
    condition: str | None,
    noisy: int,
    report: Callable[[str], None],
) -> Path:
    """Write the bounds of the first `count` finished runs of a study, and return where.

    `protocol_name` is the protocol that the study was made by; `condition` one of its conditions, by default the first.
    Images are seen on pixels of about `pixel_mm`. On the first `noisy` of them, images with nothing but the noise of
    photons are registered as well. Procedures that are in the file already are not made again; patients around real
    bones are passed over. Raises `InputError` where study and protocol do not fit.
    """
    protocol = load_protocol(protocol_name)
    settings = settings_of(protocol, Path(protocol_name).stem)
    name = condition or protocol.vary[0].name
    if name not in settings:
        raise InputError(f"--condition {name}: the protocol has no such condition; it has: {', '.join(settings)}.")
    runs = read_study(study)
    runs = runs[runs["condition"].eq(name) & runs["status"].eq(DONE) & runs["kind"].eq(PROCEDURAL)].head(count)
    if runs.empty:
        raise InputError(f"{study}: holds no finished run of the condition {name!r} on a procedural patient.")
    path = study / BOUNDS_NAME
    rows: list[Row] = read_table(path).to_pylist() if path.is_file() else []
    for place, (_, run) in enumerate(runs.iterrows()):
        procedure = _procedure(protocol, run, study)
        head = {key: run[key] for key in (*_SAME, "patient", "side", "seed")} | {"pixel_mm": pixel_mm}
        there = {row["what"] for row in rows if all(row.get(key) == head[key] for key in (*_SAME, "pixel_mm"))}
        register = place < noisy
        if BOUND in there and (REGISTERED in there or not register):
            continue
        report(f"procedure {procedure.number}")
        rows = [row for row in rows if (row["condition"], row["number"]) != (name, procedure.number)]
        rows += [head | row for row in procedure_rows(settings[name], procedure, pixel_mm, register)]
        with temporary_file(path) as part:
            pd.DataFrame(rows).to_parquet(part, index=False)
    return path


def _procedure(protocol: Protocol, run: "pd.Series[Any]", study: Path) -> Procedure:
    """The procedure of a run. Raises `InputError` if the protocol draws another of that number."""
    found = protocol.procedure(int(run["number"]), real=False)
    if (found.patient, found.side, found.seed) != (run["patient"], run["side"], int(run["seed"])):
        raise InputError(
            f"{study}: procedure {found.number} is patient {run['patient']}, {run['side']}, seed {run['seed']}, which "
            "the protocol does not draw. Give the study's own protocol."
        )
    return found


def procedure_rows(setting: Setting, procedure: Procedure, pixel_mm: float, register: bool) -> Iterator[Row]:
    """The rows of one procedure under `setting`: bounds, shares, and errors by the noise of photons alone."""
    with tempfile.TemporaryDirectory() as parent:
        body = Body(procedure, Stores(Path(parent), Path(parent), Path(parent)), Path(parent) / "body")
        imagined = imagine(setting, procedure, body, Path(parent), pixel_mm)
        yield from bound_rows(imagined)
        if register:
            theatre, case = imagined.theatre, Path(parent) / "case"
            orbit = {"isocentre_mm": imagined.carm.isocentre_mm, "orbit_axis": imagined.carm.orbit_axis}
            carm = Path(parent) / "carm.yaml"
            write_text(carm, yaml.safe_dump(plain(asdict(theatre.camera) | orbit)))
            make_case(replace(setting.variation, carm=str(carm)), procedure, setting.simulation, body, case)
            yield registered_row(case, setting.plan, theatre.poses, theatre.model, procedure.seed)


def imagine(setting: Setting, procedure: Procedure, body: Body, scratch: Path, pixel_mm: float) -> Imagined:
    """A procedure as it would be imaged, on pixels of about `pixel_mm`, and what its images say.

    Raises `InputError` where patients move between images or the X-rays have what the bound does not know.
    """
    content = simulation_of(setting.variation, setting.simulation)
    settings = read_record(Simulation, content, f"condition {setting.variation.name}")
    acquisition = settings.acquisition
    moves = (acquisition.moved_deg, acquisition.moved_mm, acquisition.device_moved_deg, acquisition.device_moved_mm)
    if any(moves) or acquisition.table_parts:
        raise InputError(
            "bound: patients and devices that move between images, and tables with parts, are not known here."
        )
    known = read_preoperative(body.patient(), procedure.hip, body.device_seed, settings, scratch / f"{DEVICE}.stl")
    mesh = read_mesh(known.device.model.path)
    drawn = draw_procedure(known, mesh, acquisition, torch.Generator().manual_seed(procedure.seed))
    case, carm = known.case, known.case.carm
    assert case.anatomy is not None  # of a femoroplasty
    pelvis = tuple(n for bone in case.anatomy.members(PELVIS) for n in case.bones[bone])
    ct, labels = body.imaged(known)
    tissue = posed_tissue(ct, labels, known.femur, known.head, drawn, carm.camera, apart=[pelvis])
    binned = max(1, round(pixel_mm / carm.camera.mean_pixel_mm))
    theatre = Theatre(
        tissue,
        metal_in_beam(mesh, body.device_seed, acquisition).device,
        drawn.truth,
        reference_points(case),
        carm.camera.downsampled(binned),
        binned,
        acquisition.step_mm,
        settings.xray,
    )
    return Imagined(theatre, tuple(image.information for image in simulated_images(theatre)), carm)


def bound_rows(imagined: Imagined) -> Iterator[Row]:
    """Bounds of all errors, whatever else is unknown and whichever images there are, and the share of every image."""
    poses, images = imagined.theatre.poses, imagined.images
    responses = error_responses(poses, imagined.theatre.points)
    prior = _cameras(imagined)
    wide = {block for part in images for block in part.widths}

    def told(parts: Sequence[Information], unknown: Sequence[str]) -> Row:
        found = bound(parts, unknown)
        asked = {column: response for column, response in responses.items() if set(response) <= set(unknown)}
        return {column: found.deviation(response) for column, response in asked.items()}

    for name, kinds in _UNKNOWN.items():
        unknown = _blocks(wide, poses, kinds)
        yield {"what": BOUND, "unknown": name, "images": ALL_IMAGES} | told((*images, prior), unknown)
    usual = _blocks(wide, poses, _UNKNOWN[USUAL])
    views = range(len(poses.camera_from_camera1))
    known = [block for block in usual if block not in {view_block(view) for view in views}]
    yield {"what": BOUND, "unknown": _CARM_KNOWN, "images": ALL_IMAGES} | told(images, known)
    for image in images:
        left = [part for part in images if part is not image]
        yield {"what": BOUND, "unknown": USUAL, "images": without_name(image.name)} | told(left, usual)
    for count in views[1:]:
        seen = {str(view + 1) for view in range(count)}
        left = [part for part in images if part.name.rsplit(" ", 1)[-1] in seen]
        kept = [block for block in usual if block not in {view_block(view) for view in views[count:]}]
        yield {"what": BOUND, "unknown": USUAL, "images": first_views_name(count)} | told(left, kept)
    whole = bound(images, usual)
    noise = {column: whole.shares_of_noise(response) for column, response in responses.items()}
    about = {block: shares_of_information(images, block) for block in _blocks(wide, poses, ())}
    for image in images:
        of_noise = {column: shares[image.name] for column, shares in noise.items()}
        yield {"what": NOISE, "unknown": USUAL, "images": image.name} | of_noise
        of_objects = {f"{block}_mm": shares[image.name] for block, shares in about.items()}
        yield {"what": INFORMATION, "unknown": POSES_ALONE, "images": image.name} | of_objects


def _blocks(there: set[str], poses: Poses, kinds: Sequence[str]) -> list[str]:
    """The blocks of all poses, and of other unknowns whose kinds these are."""
    placed = [*poses.camera1_from, *(view_block(view) for view in range(1, len(poses.camera_from_camera1)))]
    others = []
    for block in sorted(there - set(placed)):
        kind = next((k for k in ("density", "shape") if k in block), block.split()[0])
        kind = "camera" if block == DISTANCE or block.startswith("principal") else kind
        if kind in kinds:
            others.append(block)
    return [*placed, *others]


def _cameras(imagined: Imagined) -> Information:
    """What the C-arm's file says of its cameras."""
    uncertainty = imagined.carm.assumed_uncertainty
    views = range(len(imagined.theatre.poses.camera_from_camera1))
    matrices = [known_before("", {DISTANCE: uncertainty.sdd_percent / 100}).matrix]
    matrices += [known_before("", dict.fromkeys("xy", uncertainty.principal_point_mm)).matrix for _ in views]
    widths = {DISTANCE: 1} | {principal_block(view): 2 for view in views}
    return Information("C-arm's file", widths, torch.block_diag(*matrices))


def registered_row(folder: Path, plan: Plan, truth: Poses, model: XrayModel, seed: int) -> Row:
    """Errors of the last stage of `plan` that moves all, from the truth; images show what it draws, and photon noise.

    The case in `folder` tells everything but the images: these are what the stage itself draws at the truth, with as
    many photons as there would be in the open beam of the X-rays.
    """
    stages = (step for step in reversed(plan.steps) if isinstance(step, Stage))
    stage = next(stage for stage in stages if any(PELVIS in body.move for body in stage.bodies))
    case = read_case(folder)
    scene = prepare_scene(case)
    carm = replace(scene.carm, camera=stage.level.camera(scene.carm.camera))
    black: tuple[Tensor | None, ...] = (torch.zeros(carm.camera.shape),) * scene.views
    scene = replace(scene, carm=carm, images=dict.fromkeys(scene.images, black), fields={}, segmentations=())
    points = reference_points(case, scene)
    photons = photons_per_pixel(model, carm.camera)
    images = drawn_images(scene, truth, points, stage.level.step_mm, stage.imaging, photons)
    noisy = with_noise(scene, images, photons, torch.Generator().manual_seed(seed))
    *_, last = stage.run(noisy, truth, seed)
    return {"what": REGISTERED, "unknown": USUAL, "images": ALL_IMAGES} | flat_errors(errors(truth, last.poses, points))
