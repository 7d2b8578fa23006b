"""`python -m sim.study COMMAND …`: measures what `docs/accuracy.md` and `docs/planning.md` tell; see the Makefile."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jsonargparse import auto_cli

from femoreg_torch.errors import InputError
from femoreg_torch.registration import load_plan
from sim.study import ablation as variants
from sim.study import accuracy as measurement
from sim.study import capture
from sim.study import plans as planning
from sim.study.cases import Stores, ready
from sim.study.conditions import Imaged, make_conditions, read_conditions
from sim.study.conditions_page import write_conditions
from sim.study.plans_page import write_plans
from sim.study.procedures import Procedure, Study, load_study, procedures
from sim.study.timing import time_register
from sim.study.trust import sabotaged_runs, write_trust

_DATA = Path(os.environ.get("FEMOREG_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
_OUT = Path("out/accuracy")
_PAPER_RUNS = Path(__file__).resolve().parents[2] / "docs" / "results" / "paper"
Kind = Literal["all", "procedural", "real"]


def cases(
    first: int | None = None,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
) -> None:
    """Make the simulated procedures, and keep them; those that are there stay as they are.

    Args:
        first: only the first so many.
        kind: patients to take.
        out: folder that holds, or will hold, `cases/`.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: cases made at the same time, on one core each; a case needs some gigabytes of memory.
    """
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    measurement.make_cases(chosen, study, stores, jobs)


def accuracy(
    preset: str = "fast",
    first: int | None = None,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
    reuse: bool = False,
    timed: int = 0,
    docs: Path | None = None,
) -> None:
    """Register the simulated procedures, making those that are missing, and tell the errors.

    Args:
        preset: registration preset.
        first: only the first so many procedures; of the preset `paper` 20, of all others all, if not given.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: registrations at the same time, on one core each; one alone may use all cores.
        reuse: take results that are there although code or plan have changed since (those of the same code always are).
        timed: time the whole command `femoreg register` on so many of the procedures, one after the other.
        docs: folder of the page that is to be renewed.
    """
    first = 20 if first is None and preset == "paper" else first
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    measurement.make_cases(chosen, study, stores, jobs)
    plan = load_plan(preset)
    folder = out / preset
    records = measurement.register_all(chosen, study, stores, plan, folder / "runs", jobs, reuse)
    timing = time_register([stores.case(p) for p in chosen[:timed]], preset) if timed else None
    print(measurement.write_results(records, len(procedures(study)), preset, folder, docs, timing))


def capture_range(
    preset: str = "fast",
    first: int = 4,
    starts: int = 24,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    docs: Path | None = None,
) -> None:
    """Success of the pelvis stages in view 1 against the offset of the start.

    Args:
        preset: registration preset.
        first: procedures to start on.
        starts: at every offset, over all procedures together.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        docs: folder of the page that is to be renewed.
    """
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    measurement.make_cases(chosen, study, stores, 1)
    plan = load_plan(preset)
    records = capture.sweep_starts([stores.case(p) for p in chosen], plan, starts)
    print(capture.write_capture(records, plan, out / "capture", docs))


def trust(
    preset: str = "fast",
    first: int = 4,
    starts: int = 8,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    docs: Path | None = None,
) -> None:
    """Whole runs from starts that are meant to go wrong, and whether they say so.

    Args:
        preset: registration preset.
        first: procedures to start on.
        starts: of every kind, over all procedures together.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        docs: folder of the page that is to be renewed.
    """
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    measurement.make_cases(chosen, study, stores, 1)
    records = sabotaged_runs([stores.case(p) for p in chosen], load_plan(preset), starts)
    print(write_trust(records, preset, out / "trust", docs))


def ablation(
    variants_file: str = "ablation",
    first: int = 8,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
    docs: Path | None = None,
) -> None:
    """Variants of a plan on the same procedures, in one table.

    Args:
        variants_file: preset of configs/study, or a YAML file of variants.
        first: procedures to take.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: registrations at the same time, on one core each.
        docs: folder of the page that is to be renewed.
    """
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    measurement.make_cases(chosen, study, stores, jobs)
    rows = []
    for variant in variants.read_variants(variants_file):
        runs = out / "ablation" / variant.name.replace(" ", "_")
        plan = variants.plan_of(variant)
        print(variant.name, flush=True)
        records = measurement.register_all(chosen, study, stores, plan, runs, jobs, views=variant.views)
        rows.append(variants.row_of(variant, records))
    print(variants.write_ablation(rows, len(chosen), variants_file, docs))


def conditions(
    conditions_file: str = "conditions",
    only: str | None = None,
    preset: str = "fast",
    first: int | None = None,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
    cases_only: bool = False,
    reuse: bool = False,
    docs: Path | None = None,
) -> None:
    """Image the procedures under other conditions, register them, and tell the errors under each.

    Cases stand in OUT/conditions/CONDITION/PROCEDURE; those that are there stay.

    Args:
        conditions_file: preset of configs/study, or a YAML file of conditions.
        only: names of conditions, with commas in between; all, if not given.
        preset: registration preset.
        first: only the first so many procedures.
        kind: patients to take.
        out: folder of cases and results, and of `bodies/`, which later conditions reuse.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: procedures at the same time, on one core each; each needs some gigabytes of memory.
        cases_only: make the cases alone.
        reuse: take results that are there although code or plan have changed since (those of the same code always are).
        docs: folder of the page that is to be renewed.
    """
    study, chosen, stores = _chosen(first, kind, out, patients, data)
    wanted = read_conditions(conditions_file, only.split(",") if only else ())
    imaged = Imaged(out / "bodies", out / "conditions")
    make_conditions(chosen, wanted, study, stores, imaged, jobs)
    if cases_only:
        return
    plan = load_plan(preset)
    folder = out / f"{preset}_conditions"
    runs = []
    for condition in wanted:
        print(condition.name, flush=True)
        cases = replace(stores, cases=imaged.conditions / condition.name)
        records = measurement.register_all(chosen, study, cases, plan, folder / condition.name / "runs", jobs, reuse)
        runs.append((condition, records))
    command = f"python -m sim.study conditions --preset {preset} --first {len(chosen)}"
    command += f" --only {only}" if only else ""
    print(write_conditions(runs, preset, first, command, folder, docs))


def plans(
    first: int | None = None,
    meshes: bool = True,
    out: Path = Path("out/plans"),
    data: Path = _DATA,
    docs: Path | None = None,
) -> None:
    """Plan cement for three femora, move the plans, compare meshes; goes on where it was stopped.

    Args:
        first: only the first so many femora.
        meshes: compare meshes on the first femur.
        out: folder of cases and plans, and of what was measured so far.
        data: folder with the real CTs in ct/; the environment's FEMOREG_DATA, if set.
        docs: folder of the page that is to be renewed, with all that was measured so far.
    """
    for number, subject in enumerate(planning.SUBJECTS[:first]):
        print(subject.title, flush=True)
        planning.measure(subject, out, data)
        planning.compare_laws(subject, out)
        if number == 0:
            planning.draw_errors(subject, out, _PAPER_RUNS)
        if meshes and number == 0:
            planning.compare_meshes(subject, out)
    if docs is not None:
        found = [known for subject in planning.SUBJECTS if (known := planning.measured(subject, out)) is not None]
        print(write_plans(found, "make plans", docs))


def listing(first: int | None = None, kind: Kind = "all", out: Path = _OUT) -> None:
    """Which procedures the study has, and which of their cases are there.

    Args:
        first: only the first so many.
        kind: patients to take.
        out: folder of cases.
    """
    study, chosen, stores = _chosen(first, kind, out, None, _DATA)
    for procedure in chosen:
        print(f"{'ready' if ready(procedure, study, stores) else '-----'}  {stores.case(procedure)}")


def _chosen(
    first: int | None, kind: Kind, out: Path, patients: Path | None, data: Path
) -> tuple[Study, list[Procedure], Stores]:
    study = load_study("accuracy")
    fitting = [p for p in procedures(study) if kind in ("all", "procedural" if p.procedural else "real")]
    return study, fitting[:first], Stores(out / "cases", patients or out / "patients", data)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input is told in one line, with exit status 2."""
    commands: dict[str, Any] = {
        "accuracy": accuracy,
        "cases": cases,
        "capture-range": capture_range,
        "trust": trust,
        "ablation": ablation,
        "conditions": conditions,
        "plans": plans,
        "list": listing,
    }
    try:
        auto_cli(commands, args=None if arguments is None else list(arguments), as_positional=False)
    except InputError as error:
        print(f"sim.study: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
