"""`python -m sim.study COMMAND …`: measures what `docs/accuracy.md` and `docs/planning.md` tell; see the Makefile."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from jsonargparse import auto_cli

from femoreg_torch.commands.status import BAD_INPUT, DONE
from femoreg_torch.errors import InputError
from femoreg_torch.registration import load_plan
from femoreg_torch.statistics.study import read_study
from sim.study import ablation as variants
from sim.study import capture
from sim.study import plans as planning
from sim.study.accuracy_page import write_results
from sim.study.cadaver import cadaver
from sim.study.cases import Stores
from sim.study.conditions import Imaged, is_made, make_conditions
from sim.study.conditions_page import write_conditions
from sim.study.executors import OnThisMachine
from sim.study.limits import limits as limits_of
from sim.study.plans_page import write_plans
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, load_protocol
from sim.study.store import Run
from sim.study.telling import carry_out_told
from sim.study.timing import time_register
from sim.study.trust import plan_trust, write_trust
from sim.study.work import Setting, settings_of
from sim.study.yardsticks import only_these, plan_yardstick, take_earlier

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
) -> int:
    """Make the simulated procedures, and keep them; those that are there stay as they are.

    Args:
        first: only the first so many.
        kind: patients to take.
        out: folder that holds, or will hold, `conditions/uniform/`.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: cases made at the same time, on one core each; a case needs some gigabytes of memory.
    """
    _make_cases(_chosen("accuracy", "fast", first, kind, out, patients, data), jobs)
    return DONE


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
) -> int:
    """Register the simulated procedures, making those that are missing, and tell the errors.

    Runs are kept in OUT/PRESET as `femoreg study` keeps them: started again, the command goes on with those that are
    missing. Status 1 if a run failed.

    Args:
        preset: registration preset.
        first: only the first so many procedures; of the preset `paper` 20, of all others all, if not given.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: procedures at the same time, on one core each; each needs some gigabytes of memory.
        reuse: take results that are there although code or plan have changed since (those of the same code always are).
        timed: time the whole command `femoreg register` on so many of the procedures, one after the other.
        docs: folder of the page that is to be renewed.
    """
    first = 20 if first is None and preset == "paper" else first
    chosen = _chosen("accuracy", preset, first, kind, out, patients, data)
    folder = out / preset
    status, rows = _carried_out(
        "accuracy", chosen, chosen.settings, folder, jobs, reuse, lambda run: folder / "runs" / _earlier_name(run)
    )
    timing = time_register(chosen.cases()[:timed], preset) if timed else None
    total = len(chosen.protocol.first(chosen.protocol.procedures, real=True))
    print(write_results(rows, total, preset, folder, docs, timing))
    return status


def capture_range(
    preset: str = "fast",
    first: int = 4,
    starts: int = 96,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    docs: Path | None = None,
) -> int:
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
    chosen = _chosen("accuracy", preset, first, kind, out, patients, data)
    _make_cases(chosen, 1)
    plan = load_plan(preset)
    records = capture.sweep_starts(chosen.cases(), plan, starts)
    print(capture.write_capture(records, plan, out / "capture", docs))
    return DONE


def trust(
    preset: str = "fast",
    first: int = 4,
    starts: int = 8,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
    docs: Path | None = None,
) -> int:
    """Whole runs from starts that are meant to go wrong, and whether they say so; kept in OUT/trust_PRESET.

    Args:
        preset: registration preset.
        first: procedures to start on.
        starts: of every kind, over all procedures together.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: procedures at the same time, on one core each.
        docs: folder of the page that is to be renewed.
    """
    chosen = _chosen("accuracy", preset, first, kind, out, patients, data)
    _make_cases(chosen, jobs)
    folder = out / f"trust_{preset}"
    (setting,) = chosen.settings.values()
    study = plan_trust(setting, chosen.procedures, chosen.stores, chosen.imaged, starts)
    status = carry_out_told(study, folder, OnThisMachine(jobs), reuse=False)
    print(write_trust(read_study(folder), preset, docs))
    return status


def ablation(
    variants_file: str = "ablation",
    first: int = 8,
    kind: Kind = "all",
    out: Path = _OUT,
    patients: Path | None = None,
    data: Path = _DATA,
    jobs: int = 1,
    docs: Path | None = None,
) -> int:
    """Variants of a plan on the same procedures, in one table; kept in OUT/ablation.

    Args:
        variants_file: preset of configs/study, or a YAML file of variants.
        first: procedures to take.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: procedures at the same time, on one core each.
        docs: folder of the page that is to be renewed.
    """
    chosen = _chosen("accuracy", "fast", first, kind, out, patients, data)
    (usual,) = chosen.settings.values()
    listed = variants.read_variants(variants_file)
    settings = {
        variant.condition: replace(
            usual, plan=variants.plan_of(variant), variation=replace(usual.variation, views=variant.views)
        )
        for variant in listed
    }
    status, rows = _carried_out("ablation", chosen, settings, out / "ablation", jobs)
    lines = [variants.row_of(variant, rows[rows["condition"].eq(variant.condition)]) for variant in listed]
    print(variants.write_ablation(lines, len(chosen.procedures), variants_file, docs))
    return status


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
) -> int:
    """Image the procedures under other conditions, register them, and tell the errors under each.

    Cases stand in OUT/conditions/CONDITION/PROCEDURE; those that are there stay. Runs are kept in
    OUT/PRESET_conditions as `femoreg study` keeps them. Status 1 if a run failed.

    Args:
        conditions_file: protocol of configs/study, or a YAML file.
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
    every = _chosen(conditions_file, preset, first, kind, out, patients, data)
    settings = only_these(every.settings, only.split(",") if only else (), f"conditions {conditions_file}")
    chosen = replace(every, settings=settings, imaged=replace(every.imaged, bodies=(out / "bodies").resolve()))
    if cases_only:
        _make_cases(chosen, jobs)
        return DONE
    folder = out / f"{preset}_conditions"
    name = Path(conditions_file).stem
    status, rows = _carried_out(
        name, chosen, settings, folder, jobs, reuse, lambda run: folder / run.condition / "runs" / _earlier_name(run)
    )
    command = f"python -m sim.study conditions --preset {preset} --first {len(chosen.procedures)}"
    command += f" --only {only}" if only else ""
    print(write_conditions(rows, list(settings), preset, first, command, docs))
    return status


def limits(
    study: Path,
    protocol: str = "paper",
    condition: str | None = None,
    first: int = 6,
    noise_alone: int = 0,
    pixel_mm: float = 0.78,
) -> int:
    """Tell how far a study's errors are from what its images allow: Cramér–Rao bounds, and what each image is worth.

    Procedures are made anew from their seeds, a minute or so each on one core, and images are not. The bounds go to
    STUDY/bounds.parquet; `femoreg tables` and `femoreg report` then tell them beside the errors. Those that are there
    stay.

    Args:
        study: folder of a study by `femoreg study`, of procedural patients.
        protocol: its protocol, a preset of configs/study or a YAML file.
        condition: its condition; the first one of the protocol, if not given.
        first: only the first so many finished runs.
        noise_alone: on so many of these, also register images with nothing but the noise of photons.
        pixel_mm: edge of the pixels that images are seen on.
    """
    path = limits_of(protocol, study, first, pixel_mm, condition, noise_alone, lambda what: print(what, flush=True))
    print(f"Bounds: {path}. `femoreg tables {study}` tells them.")
    return DONE


def plans(
    first: int | None = None,
    meshes: bool = True,
    out: Path = Path("out/plans"),
    data: Path = _DATA,
    docs: Path | None = None,
) -> int:
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
    return DONE


def listing(first: int | None = None, kind: Kind = "all", out: Path = _OUT) -> int:
    """Which procedures the study has, and which of their cases are there.

    Args:
        first: only the first so many.
        kind: patients to take.
        out: folder of cases.
    """
    chosen = _chosen("accuracy", "fast", first, kind, out, None, _DATA)
    (setting,) = chosen.settings.values()
    for procedure, folder in zip(chosen.procedures, chosen.cases(), strict=True):
        made = is_made(setting.variation, procedure, setting.simulation, chosen.imaged)
        print(f"{'ready' if made else '-----'}  {folder}")
    return DONE


@dataclass(frozen=True)
class _Chosen:
    """Procedures of a protocol, the settings of its conditions by name, and the folders of what is kept."""

    protocol: Protocol
    settings: Mapping[str, Setting]
    procedures: list[Procedure]
    stores: Stores
    imaged: Imaged

    def cases(self) -> list[Path]:
        """The case folders of the first condition."""
        setting = next(iter(self.settings.values()))
        return [self.imaged.case(setting.variation, procedure) for procedure in self.procedures]


def _chosen(
    name: str, preset: str, first: int | None, kind: Kind, out: Path, patients: Path | None, data: Path
) -> _Chosen:
    protocol = replace(load_protocol(name), preset=preset)
    every = protocol.first(protocol.procedures, real=True)
    fitting = [p for p in every if kind in ("all", "procedural" if p.procedural else "real")]
    stores = Stores(out / "cases", (patients or out / "patients").resolve(), data.resolve())
    imaged = Imaged(None, (out / "conditions").resolve())
    return _Chosen(protocol, settings_of(protocol, name), fitting[:first], stores, imaged)


def _make_cases(chosen: _Chosen, jobs: int) -> None:
    settings = list(chosen.settings.values())
    variations = [setting.variation for setting in settings]
    make_conditions(chosen.procedures, variations, settings[0].simulation, chosen.stores, chosen.imaged, jobs)


def _carried_out(
    name: str,
    chosen: _Chosen,
    settings: Mapping[str, Setting],
    folder: Path,
    jobs: int,
    reuse: bool = False,
    earlier: Callable[[Run], Path] | None = None,
) -> tuple[int, pd.DataFrame]:
    """Make the runs that are missing. Returns the exit status and the rows of all; `earlier` see `take_earlier`."""
    study = plan_yardstick(name, chosen.protocol, settings, chosen.procedures, chosen.stores, chosen.imaged, folder)
    if reuse and earlier is not None and (taken := take_earlier(study, folder, earlier)):
        print(f"{taken} records of versions before the engine are taken over.")
    status = carry_out_told(study, folder, OnThisMachine(jobs), reuse)
    return status, read_study(folder)


def _earlier_name(run: Run) -> str:
    return f"{run.procedure.name}.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input is told in one line, with exit status 2."""
    commands: dict[str, Any] = {
        "accuracy": accuracy,
        "cases": cases,
        "capture-range": capture_range,
        "trust": trust,
        "ablation": ablation,
        "conditions": conditions,
        "limits": limits,
        "cadaver": cadaver,
        "plans": plans,
        "list": listing,
    }
    try:
        status = auto_cli(commands, args=None if arguments is None else list(arguments), as_positional=False)
    except InputError as error:
        print(f"sim.study: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    return int(status or DONE)


if __name__ == "__main__":
    sys.exit(main())
