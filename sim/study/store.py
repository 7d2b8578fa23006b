"""The folder of a study: one file per run, written as soon as the run is done, and scratch space for those in flight.

Any number of processes, on any number of machines, may write into one folder; one command at a time has charge of it.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, write_json
from sim.study.owner import is_left, mark, owning
from sim.study.procedures import Procedure
from sim.study.record import Record

_RUNS, _SCRATCH = "runs", "scratch"
FAILED = "failed"  # a run that a defect ended; it is no result, and is tried again


@dataclass(frozen=True)
class Run:
    """One procedure under one condition. Runs of one name are the same run, whichever code makes them."""

    study: str
    condition: str
    procedure: Procedure
    settings: str  # digest of all that the run is made with
    kind: str  # of patient: procedural, real or recorded
    preset: str  # of the registration
    varied: tuple[tuple[str, Any], ...] = ()  # what its condition changes, by name

    @property
    def name(self) -> str:
        """Unique within a study; serves as the name of its file."""
        return f"{self.condition}-{self.procedure.number:05d}-{self.settings[:8]}"


@dataclass(frozen=True)
class Batch:
    """The runs on one procedure, which one process does one after another: its patient is made once for all."""

    procedure: Procedure
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Store:
    """Where the records of a study are kept, and by which code they are made."""

    folder: Path
    code: str

    def prepare(self) -> None:
        """Make the folders, and remove what killed runs have left in the scratch space."""
        for name in (_RUNS, _SCRATCH):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.clear_killed()

    @contextmanager
    def in_charge(self) -> Iterator[None]:
        """Raises `InputError` if another command has charge of the folder, and may still be alive."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with owning(self.folder):
            yield

    def path(self, run: Run) -> Path:
        """Of the record of a run."""
        return self.folder / _RUNS / f"{run.name}.json"

    def record(self, run: Run) -> Record | None:
        """What is known of a run; None if it was not made, or its file is damaged: it is then made anew."""
        try:
            return read_json(self.path(run))
        except InputError:
            return None

    def write(self, run: Run, found: Record) -> None:
        """Keep what a run has found, in place of what an older one did."""
        known = {"study": run.study, "condition": run.condition, "varied": dict(run.varied)}
        write_json(self.path(run), known | found | {"code": self.code, "settings": run.settings})

    def count_others(self, runs: Sequence[Run]) -> int:
        """How many records there are beside those of these runs."""
        names = {self.path(run).name for run in runs}
        return sum(path.name not in names for path in (self.folder / _RUNS).glob("*.json"))

    @contextmanager
    def scratch(self, number: int) -> Iterator[Path]:
        """A folder for a procedure in flight, marked as this process's, and removed afterwards."""
        with tempfile.TemporaryDirectory(prefix=f"{number:05d}-", dir=self.folder / _SCRATCH) as folder:
            mark(Path(folder))
            yield Path(folder)

    def clear_killed(self) -> set[int]:
        """Remove the scratch folders of processes of this machine that are gone. Returns their procedures."""
        numbers = set()
        for left in (self.folder / _SCRATCH).iterdir():
            if is_left(left):
                numbers.add(int(left.name.partition("-")[0]))
                shutil.rmtree(left, ignore_errors=True)
        return numbers


def missing(store: Store, runs: Sequence[Run], reuse: bool) -> list[Run]:
    """The runs that are to be made: those without a result of this code; with `reuse`, of any code."""
    found = []
    for run in runs:
        record = store.record(run)
        if record is None or record["status"] == FAILED or not (reuse or record["code"] == store.code):
            found.append(run)
    return found


def batches(runs: Sequence[Run]) -> list[Batch]:
    """Runs by procedure, in the order of the procedures."""
    by_number: dict[int, Batch] = {}
    for run in sorted(runs, key=lambda run: run.procedure.number):
        batch = by_number.setdefault(run.procedure.number, Batch(run.procedure, ()))
        by_number[run.procedure.number] = replace(batch, runs=(*batch.runs, run))
    return list(by_number.values())
