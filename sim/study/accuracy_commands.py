"""`python -m sim.study cases`, `accuracy`, `conditions`, `ablation`, `list`: the procedures of the accuracy page."""

from dataclasses import replace
from pathlib import Path

from femoreg_torch.commands.status import DONE
from sim.study import ablation as variants
from sim.study.accuracy_page import write_results
from sim.study.chosen import DATA, OUT, Kind, carried_out, chosen_of, earlier_name, make_cases
from sim.study.conditions import is_made
from sim.study.conditions_page import write_conditions
from sim.study.timing import time_register
from sim.study.yardsticks import only_these


def cases(
    first: int | None = None,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
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
    make_cases(chosen_of("accuracy", "fast", first, kind, out, patients, data), jobs)
    return DONE


def accuracy(
    preset: str = "fast",
    first: int | None = None,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
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
    chosen = chosen_of("accuracy", preset, first, kind, out, patients, data)
    folder = out / preset
    status, rows = carried_out(
        "accuracy", chosen, chosen.settings, folder, jobs, reuse, lambda run: folder / "runs" / earlier_name(run)
    )
    timing = time_register(chosen.cases()[:timed], preset) if timed else None
    total = len(chosen.protocol.first(chosen.protocol.procedures, real=True))
    print(write_results(rows, total, preset, folder, docs, timing))
    return status


def conditions(
    conditions_file: str = "conditions",
    only: str | None = None,
    preset: str = "fast",
    first: int | None = None,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
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
    every = chosen_of(conditions_file, preset, first, kind, out, patients, data)
    settings = only_these(every.settings, only.split(",") if only else (), f"conditions {conditions_file}")
    chosen = replace(every, settings=settings, imaged=replace(every.imaged, bodies=(out / "bodies").resolve()))
    if cases_only:
        make_cases(chosen, jobs)
        return DONE
    folder = out / f"{preset}_conditions"
    name = Path(conditions_file).stem
    status, rows = carried_out(
        name, chosen, settings, folder, jobs, reuse, lambda run: folder / run.condition / "runs" / earlier_name(run)
    )
    command = f"python -m sim.study conditions --preset {preset} --first {len(chosen.procedures)}"
    command += f" --only {only}" if only else ""
    print(write_conditions(rows, list(settings), preset, first, command, docs))
    return status


def ablation(
    variants_file: str = "ablation",
    first: int = 8,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
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
    chosen = chosen_of("accuracy", "fast", first, kind, out, patients, data)
    (usual,) = chosen.settings.values()
    listed = variants.read_variants(variants_file)
    settings = {
        variant.condition: replace(
            usual, plan=variants.plan_of(variant), variation=replace(usual.variation, views=variant.views)
        )
        for variant in listed
    }
    status, rows = carried_out("ablation", chosen, settings, out / "ablation", jobs)
    lines = [variants.row_of(variant, rows[rows["condition"].eq(variant.condition)]) for variant in listed]
    print(variants.write_ablation(lines, len(chosen.procedures), variants_file, docs))
    return status


def listing(first: int | None = None, kind: Kind = "all", out: Path = OUT) -> int:
    """Which procedures the study has, and which of their cases are there.

    Args:
        first: only the first so many.
        kind: patients to take.
        out: folder of cases.
    """
    chosen = chosen_of("accuracy", "fast", first, kind, out, None, DATA)
    (setting,) = chosen.settings.values()
    for procedure, folder in zip(chosen.procedures, chosen.cases(), strict=True):
        made = is_made(setting.variation, procedure, setting.simulation, chosen.imaged)
        print(f"{'ready' if made else '-----'}  {folder}")
    return DONE
