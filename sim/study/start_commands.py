"""`python -m sim.study capture-range` and `trust`: starts that are off."""

from pathlib import Path

from femoreg_torch.statistics.study import read_study
from sim.study.capture import plan_capture, write_capture
from sim.study.chosen import DATA, OUT, Kind, chosen_of, make_cases
from sim.study.executors import OnThisMachine
from sim.study.telling import carry_out_told
from sim.study.trust import plan_trust, write_trust


def capture_range(
    preset: str = "fast",
    first: int = 4,
    starts: int = 96,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
    jobs: int = 1,
    reuse: bool = False,
    docs: Path | None = None,
) -> int:
    """Success of the pelvis stages in view 1 against the offset of the start; kept in OUT/capture_PRESET.

    Args:
        preset: registration preset.
        first: procedures to start on.
        starts: at every offset, over all procedures together.
        kind: patients to take.
        out: folder of cases and results.
        patients: CTs around real bone shapes; OUT/patients if not given.
        data: folder with meshes/SUBJECT.npz of the real bones; the environment's FEMOREG_DATA, if set.
        jobs: procedures at the same time, on one core each.
        reuse: take results that are there although code or plan have changed since (those of the same code always are).
        docs: folder of the page that is to be renewed.
    """
    chosen = chosen_of("accuracy", preset, first, kind, out, patients, data)
    make_cases(chosen, jobs)
    folder = out / f"capture_{preset}"
    (setting,) = chosen.settings.values()
    study = plan_capture(setting, chosen.procedures, chosen.stores, chosen.imaged, starts)
    status = carry_out_told(study, folder, OnThisMachine(jobs), reuse)
    command = f"python -m sim.study capture-range --preset {preset} --first {first} --starts {starts}"
    print(write_capture(read_study(folder), setting.plan, command, folder, docs))
    return status


def trust(
    preset: str = "fast",
    first: int = 4,
    starts: int = 8,
    kind: Kind = "all",
    out: Path = OUT,
    patients: Path | None = None,
    data: Path = DATA,
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
    chosen = chosen_of("accuracy", preset, first, kind, out, patients, data)
    make_cases(chosen, jobs)
    folder = out / f"trust_{preset}"
    (setting,) = chosen.settings.values()
    study = plan_trust(setting, chosen.procedures, chosen.stores, chosen.imaged, starts)
    status = carry_out_told(study, folder, OnThisMachine(jobs), reuse=False)
    print(write_trust(read_study(folder), preset, docs))
    return status
