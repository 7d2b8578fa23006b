"""`femoreg study`: a protocol, and a folder that holds what has become of its runs."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from femoreg_torch.case import read_case
from femoreg_torch.case.inputs import inputs_digest
from femoreg_torch.errors import InputError
from sim.study.cases import REAL_IMAGED_MM, REGISTERED_MM, Stores, subject_folder
from sim.study.code import digest, library_and_simulator
from sim.study.engine import DISK_FULL, Executor, Work, carry_out
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, load_protocol, varied
from sim.study.record import Record
from sim.study.rows import TABLE_NAME, write_table
from sim.study.store import Run, Store, batches, missing
from sim.study.trial import check_views, kind
from sim.study.work import Recorded, Setting, Simulated, settings_of

_TABLE_S, _TABLE_SHARE = 60.0, 0.02  # the table is renewed so often, and takes at most this share of the time
OVERLAYS = "overlays"  # folder of the runs' pictures
RECORDED = "recorded"  # kind of a case that nobody simulated


@dataclass(frozen=True)
class Study:
    """All runs of a study, and how they are made."""

    runs: Sequence[Run]
    work: Work
    subjects: Sequence[str] = ()  # real bone shapes that patients are built around
    stores: Stores | None = None  # where these are


@dataclass(frozen=True)
class Told:
    """What a study has come to: numbers of runs."""

    status: dict[str, int]  # done, refused, failed
    flagged: int  # results that are not trusted
    first_failure: str | None
    table: Path


def plan_study(config: str, procedures: int | None, out: Path, data: Path | None, keep_cases: bool) -> Study:
    """The runs of the protocol `config` on its first so many procedures. Raises `InputError` for all that is amiss."""
    protocol = load_protocol(config)
    name = Path(config).stem
    count = protocol.procedures if procedures is None else procedures
    if count < 1:
        raise InputError(f"--procedures: at least 1 was expected, got {count}.")
    settings = settings_of(protocol, name)
    if protocol.cases:
        return _of_cases(protocol, name, settings, count, out)
    real = bool(data is not None and protocol.bones)
    stores = Stores(out / "cases", out / "patients", (data or Path()).resolve())
    subjects = protocol.bones if real else []
    _check_meshes(stores, subjects)
    chosen = protocol.first(count, real)
    if procedures is not None and len(chosen) < procedures:
        raise InputError(f"--procedures: study {name} has {len(chosen)} procedures, {procedures} were asked for.")
    runs = runs_of(name, settings, chosen, cohort_of(protocol, subjects))
    kept = stores.cases if keep_cases else None
    return Study(runs, Simulated(settings, stores, out.resolve() / OVERLAYS, kept), subjects, stores)


def cohort_of(protocol: Protocol, subjects: Sequence[str]) -> dict[str, Any]:
    """What the procedures of a protocol follow from."""
    if protocol.cohort is not None:
        return asdict(protocol.cohort)
    return {"seed": protocol.seed, "first_patient": protocol.first_patient, "subjects": subjects}


def runs_of(
    name: str, settings: Mapping[str, Setting], chosen: Sequence[Procedure], cohort: dict[str, Any]
) -> list[Run]:
    """The runs of a study called `name`: every procedure under every condition, in this order."""
    digests = {key: digest(cohort, setting.digest) for key, setting in settings.items()}
    return [
        _run(name, key, setting, procedure, digests[key], kind(procedure))
        for procedure in chosen
        for key, setting in settings.items()
    ]


def _of_cases(protocol: Protocol, name: str, settings: dict[str, Setting], count: int, out: Path) -> Study:
    """A study of cases that are there, in the order of the list; those that a pattern finds by name."""
    found = dict.fromkeys(folder.resolve() for pattern in protocol.cases for folder in _matching(pattern))
    folders = [folder for folder in found if (folder / "case.yaml").is_file()][:count]
    if not folders:
        raise InputError(f"study {name}, cases: no folder with a case.yaml fits {', '.join(protocol.cases)}.")
    runs, cases = [], {}
    for number, folder in enumerate(folders, 1):
        case = read_case(folder)
        procedure = Procedure(number, folder.name, case.side, protocol.procedure(number, False).seed)
        content = inputs_digest(case)
        cases[number] = folder
        for key, setting in settings.items():
            check_views(setting.variation.views, len(case.views), f"study {name}, {key}, views: {folder}")
            if case.truth is None and (setting.detections or setting.variation.start):
                raise InputError(f"{folder}: has no truth, from which `start` and `detections` could be drawn.")
            made_with = digest(protocol.seed, setting.digest, content)
            runs.append(_run(name, key, setting, procedure, made_with, RECORDED))
    return Study(runs, Recorded(settings, cases, out.resolve() / OVERLAYS))


def _matching(pattern: str) -> list[Path]:
    anchor = Path(pattern).anchor
    return sorted(Path(anchor or ".").glob(str(Path(pattern).relative_to(anchor))))


def _run(study: str, condition: str, setting: Setting, procedure: Procedure, settings: str, of_kind: str) -> Run:
    what = tuple(varied(setting.variation).items())
    return Run(study, condition, procedure, settings, of_kind, setting.plan.preset, what)


def _check_meshes(stores: Stores, subjects: Sequence[str]) -> None:
    for subject in subjects:
        mesh = stores.data / "meshes" / f"{subject}.npz"
        if not mesh.is_file():
            raise InputError(
                f"--data: {mesh}: there is no such file. Leave --data out to use procedural patients only."
            )


def run_study(
    study: Study,
    out: Path,
    executor: Executor,
    reuse: bool = False,
    begin: Callable[[int, int, int], None] = lambda todo, kept, others: None,
    progress: Callable[[int], None] = lambda done: None,
) -> Told:
    """Make the runs that are missing in the folder `out`, and write the table of all.

    Runs of other code are made anew, unless `reuse`; runs of other settings stay in the folder and out of the table.
    `begin` is told how many runs are to be made, how many are there, and how many records there are of other settings;
    `progress`, how many runs more are done. Raises `InputError` if another command writes there, or the disk is full.
    """
    out = out.resolve()
    store = Store(out, library_and_simulator())
    last = time.monotonic()
    pause = _TABLE_S

    def advance(done: int) -> None:
        nonlocal last, pause
        progress(done)
        if time.monotonic() - last > pause:
            began = time.monotonic()
            write_table(out / TABLE_NAME, _records(store, study.runs, reuse))
            last = time.monotonic()
            pause = max(_TABLE_S, (last - began) / _TABLE_SHARE)

    try:
        with store.in_charge():
            store.prepare()
            todo = missing(store, study.runs, reuse)
            begin(len(todo), len(study.runs) - len(todo), store.count_others(study.runs))
            _build_patients(study, todo)
            try:
                carry_out(study.work, store, batches(todo), executor, advance)
            except (KeyboardInterrupt, InputError):  # the latter where a cluster has gone
                write_table(out / TABLE_NAME, _records(store, study.runs, reuse))
                raise
            records = _records(store, study.runs, reuse)
            write_table(out / TABLE_NAME, records)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise InputError(
            f"{out}: {error.strerror}. The runs that are done are kept: make room, and give the same command again."
        ) from error
    return _told(records, out / TABLE_NAME)


def _build_patients(study: Study, todo: Sequence[Run]) -> None:
    """The CTs around real bone shapes that runs need: they are shared, so they are made before."""
    if study.stores is not None:
        for subject in sorted({run.procedure.patient for run in todo} & set(study.subjects)):
            for spacing_mm in (REGISTERED_MM, REAL_IMAGED_MM):
                subject_folder(subject, spacing_mm, study.stores)


def _records(store: Store, runs: Sequence[Run], reuse: bool) -> list[Record]:
    """Those of this code, or with `reuse` of any, in the order of the runs."""
    found = ((run, store.record(run)) for run in runs)
    return [
        record | {"study": run.study, "varied": dict(run.varied)}  # as the protocol has them now: they change no result
        for run, record in found
        if record is not None and (reuse or record["code"] == store.code)
    ]


def _told(records: Sequence[Record], table: Path) -> Told:
    failures = [f"{r['condition']}, procedure {r['number']}: {r['reason']}" for r in records if r["status"] == "failed"]
    flagged = sum(record["status"] == "done" and not record["trusted"] for record in records)
    return Told(Counter(record["status"] for record in records), flagged, next(iter(failures), None), table)
