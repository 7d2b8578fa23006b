"""What the commands of `python -m sim.study` share: chosen procedures, their kept cases, and runs on them."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pandas as pd

from femoreg_torch.statistics.study import read_study
from sim.study.cases import Stores
from sim.study.conditions import Imaged, make_conditions
from sim.study.executors import OnThisMachine
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, load_protocol
from sim.study.store import Run
from sim.study.telling import carry_out_told
from sim.study.work import Setting, settings_of
from sim.study.yardsticks import plan_yardstick, take_earlier

DATA = Path(os.environ.get("FEMOREG_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
OUT = Path("out/accuracy")
Kind = Literal["all", "procedural", "real"]


@dataclass(frozen=True)
class Chosen:
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


def chosen_of(
    name: str, preset: str, first: int | None, kind: Kind, out: Path, patients: Path | None, data: Path
) -> Chosen:
    """The first so many procedures of a protocol with patients of a kind, and where their cases are kept, below `out`.

    `patients` are CTs around real bone shapes (OUT/patients if None), made from the meshes in `data`.
    """
    protocol = replace(load_protocol(name), preset=preset)
    every = protocol.first(protocol.procedures, real=True)
    fitting = [p for p in every if kind in ("all", "procedural" if p.procedural else "real")]
    stores = Stores(out / "cases", (patients or out / "patients").resolve(), data.resolve())
    imaged = Imaged(None, (out / "conditions").resolve())
    return Chosen(protocol, settings_of(protocol, name), fitting[:first], stores, imaged)


def make_cases(chosen: Chosen, jobs: int) -> None:
    """Make those of the kept cases that are missing, under every condition, in so many processes."""
    settings = list(chosen.settings.values())
    variations = [setting.variation for setting in settings]
    make_conditions(chosen.procedures, variations, settings[0].simulation, chosen.stores, chosen.imaged, jobs)


def carried_out(
    name: str,
    chosen: Chosen,
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


def earlier_name(run: Run) -> str:
    """The name of a run's record as versions before the engine wrote it."""
    return f"{run.procedure.name}.json"
