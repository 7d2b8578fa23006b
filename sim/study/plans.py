"""What plans are worth on three femora, and how far that hangs on the mesh: the measured part of `docs/planning.md`.

Every number is kept in a file of its own as soon as it is there, so that a run that was stopped goes on.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from femoreg_torch.case import read_case
from femoreg_torch.commands.plan import plan_robustness
from femoreg_torch.files import read_json, write_json, write_text
from femoreg_torch.planning.convergence import MeshRow, on_mesh
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.offsets import Outcome, directions, turned_ends
from femoreg_torch.planning.path import central_path
from femoreg_torch.planning.prepare import prepare
from femoreg_torch.planning.replan import Replan
from femoreg_torch.planning.report import PLAN_NAME, add_response
from femoreg_torch.planning.response import Response, read_response
from femoreg_torch.planning.settings import load_planning
from sim.patient.real_femora import write_real_femur
from sim.theatre.case_folders import write_phantom

VOLUME_ML = 9.5  # as Basafa et al. 2015 injected on average
OFFSET_MM = 4.0  # of the paper
DRAWS = 20  # of a study's errors
MESH_SIZES_MM = (3.0, 2.5, 2.0, 1.5)
_SEED = 0  # of the search for the path
LAWS: tuple[tuple[Literal["fall", "stance"], Literal["keyak", "morgan"]], ...] = (
    ("fall", "keyak"),
    ("fall", "morgan"),
    ("stance", "keyak"),
    ("stance", "morgan"),
)
_GENERIC, _MESHES, _COST, _OUTCOMES, _LAWS = "generic", "meshes.json", "cost.json", "outcomes.json", "laws.json"
_ROBUSTNESS, _PRESET = "robustness.json", "preset.yaml"
_BETWEEN = """
import json, resource, subprocess, sys, time

began = time.perf_counter()
status = subprocess.call(sys.argv[2:])
wall, used = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
cost = {"wall_s": wall, "processor_s": used.ru_utime + used.ru_stime, "peak_gb": used.ru_maxrss / 2**20}
with open(sys.argv[1], "w", encoding="utf-8") as file:
    json.dump(cost, file)
sys.exit(status)
"""


@dataclass(frozen=True)
class Subject:
    """A femur to plan for."""

    name: str
    title: str
    make: Callable[[Path, Path], None]  # writes its case into a folder, from the folder of the real CTs
    calibration: Literal["internal", "uncalibrated"] = "internal"


def _procedural(folder: Path, data: Path) -> None:
    write_phantom(folder, 315, "left", 1.0)


def _real(name: str) -> Callable[[Path, Path], None]:
    return lambda folder, data: write_real_femur(name, data, folder)


SUBJECTS = (
    Subject("procedural", "procedural, osteoporotic (seed 315)", _procedural),
    Subject("sts_044", "real CT (STS_044), right", _real("sts_044")),
    # its tumour hides the peak of muscle, which `femoreg plan` says in one line
    Subject("sts_020", "real CT (STS_020), left, uncalibrated", _real("sts_020"), "uncalibrated"),
)


def measure(subject: Subject, out: Path, data: Path) -> None:
    """Make the case of a subject, plan it, and move the plan, as far as it is not done yet."""
    folder = out / subject.name
    case, plan = folder / "case", folder / "plan"
    if not case.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        subject.make(case, data)
    write_text(folder / _PRESET, f"extends: default\ncalibration: {{kind: {subject.calibration}}}\n")
    if not (plan / PLAN_NAME).is_file():
        write_json(folder / _COST, _timed_plan(case, plan, folder / _PRESET))
    _outcomes(folder)


def _timed_plan(case: Path, plan: Path, preset: Path) -> dict[str, Any]:
    """Run `femoreg plan` as a user does, and what it cost."""
    words = ["plan", str(case), "--out", str(plan), "--volume-ml", str(VOLUME_ML), "--seed", str(_SEED)]
    words += ["--preset", str(preset)]
    return cost_of([sys.executable, "-m", "femoreg_torch.commands.main", *words]) | {"cores": os.cpu_count()}


def cost_of(command: Sequence[str]) -> dict[str, float]:
    """Run a command; its wall and processor time, s, and its peak of memory, GB. Raises what `subprocess.run` does.

    A small process stands between: Linux counts a process's memory from before it became the command, and before that
    it is a copy of the one that started it, which is larger than a plan once it has computed fine meshes itself.
    """
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "cost.json"
        subprocess.run([sys.executable, "-c", _BETWEEN, str(told), *command], check=True)
        return dict(read_json(told))


def _outcomes(folder: Path) -> None:
    """Loads of the central line, of the plan moved in six directions, and with its end moved; each is written at once.

    At last the plan learns how its gain answers to small errors, as by `femoreg plan-offsets`.
    """
    plan, file = folder / "plan", folder / _OUTCOMES
    found: dict[str, Any] = read_json(file) if file.is_file() else {}
    if read_response(plan / PLAN_NAME) is not None:
        return
    again = Replan(plan)
    found |= {"baseline_n": again.baseline_n, "planned_n": again.planned_n}
    moves = {name: OFFSET_MM * way for name, way in directions(again.side).items()}
    moves |= turned_ends(again.stored.path, OFFSET_MM)
    if _GENERIC not in found:
        line = central_path(again.around, VOLUME_ML, again.stored.planning.path)
        found[_GENERIC] = asdict(again.along(line))
        write_json(file, found)
    for name in moves:
        if name not in found:
            found[name] = asdict(again.at(moves[name]))
            write_json(file, found)
    add_response(plan, again.response({name: Outcome(**found[name]) for name in moves}, OFFSET_MM))


def compare_meshes(subject: Subject, out: Path, sizes_mm: Sequence[float] = MESH_SIZES_MM) -> None:
    """Yield load, and gain of the planned cement, of a subject that has a plan, on each mesh that is not done yet."""
    folder = out / subject.name
    file = folder / _MESHES
    rows: dict[str, Any] = read_json(file) if file.is_file() else {}
    missing = [size for size in sizes_mm if f"{size:g}" not in rows]
    if not missing:
        return
    again = Replan(folder / "plan")
    path, prepared = again.stored.path, again.prepared
    cement = diffuse(prepared.bone, path.injections(), prepared.planning.diffusion)
    for size in missing:
        rows[f"{size:g}"] = asdict(on_mesh(prepared, cement, size))
        write_json(file, rows)


def draw_errors(subject: Subject, out: Path, study: Path) -> None:
    """Carry the plan of a subject out under the errors of a study's registrations, unless it is done."""
    plan = out / subject.name / "plan"
    if not (plan / _ROBUSTNESS).is_file():
        plan_robustness(plan, study=study, draws=DRAWS)


def compare_laws(subject: Subject, out: Path) -> None:
    """Yield loads without cement of a subject in a fall and in stance, by both laws of bone, that are not done yet."""
    folder = out / subject.name
    file = folder / _LAWS
    found: dict[str, Any] = read_json(file) if file.is_file() else {}
    case, planning = read_case(folder / "case"), load_planning(folder / _PRESET)
    for kind, law in LAWS:
        if f"{kind} {law}" not in found:
            bone, load = replace(planning.bone, law=law), replace(planning.load, kind=kind)
            curve = prepare(case, replace(planning, bone=bone, load=load)).curve()
            found[f"{kind} {law}"] = {"yield_load_n": curve.yield_load_n, "stiffness_n_mm": curve.stiffness_n_mm}
            write_json(file, found)


@dataclass(frozen=True)
class Measured:
    """What there is of a subject."""

    subject: Subject
    cost: dict[str, Any]
    plan: dict[str, Any]
    outcomes: dict[str, Any]
    meshes: list[MeshRow]
    laws: dict[str, Any]
    draws: dict[str, Any]  # what `femoreg plan-robustness` wrote
    response: Response | None


def measured(subject: Subject, out: Path) -> Measured | None:
    """What was measured of a subject so far; None if it has no plan yet."""
    folder = out / subject.name
    if not (folder / "plan" / PLAN_NAME).is_file():
        return None
    kept = [read_json(path) if (path := folder / name).is_file() else {} for name in (_COST, _OUTCOMES, _MESHES, _LAWS)]
    rows = sorted((MeshRow(**row) for row in kept[2].values()), key=lambda row: -row.size_mm)
    plan, draws = folder / "plan" / PLAN_NAME, folder / "plan" / _ROBUSTNESS
    drawn = read_json(draws) if draws.is_file() else {}
    return Measured(subject, kept[0], read_json(plan), kept[1], rows, kept[3], drawn, read_response(plan))


def gain_percent(found: Measured, name: str) -> float:
    """Gain over the bare femur of `generic` or a direction, %; nan if it was not run."""
    outcome = found.outcomes.get(name)
    return float("nan") if outcome is None else 100 * (outcome["yield_load_n"] / found.outcomes["baseline_n"] - 1)


def six_directions(found: Measured) -> np.ndarray:
    """Gains (6,) of the moved plan, %."""
    return np.array([gain_percent(found, name) for name in directions("left")])
