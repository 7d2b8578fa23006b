"""`femoreg batch`: many cases registered, several at a time, each run kept as soon as it is done."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rich.console import Console

    from femoreg_torch.case import Result

_NO_RESULT = ("refused", "failed")


@dataclass(frozen=True)
class Job:
    """One case, and how it is registered."""

    case: Path
    out: Path
    preset: str
    seed: int
    weights: Path | None
    threads: int
    device: str = "cpu"


@dataclass(frozen=True)
class Row:
    """What became of one case: a line of the table."""

    case: str
    status: str  # done, kept (from an earlier run), refused or failed
    trusted: bool
    reasons: str
    seconds: float
    errors: dict[str, float]  # mm and degrees by name, where the case has a truth


def batch(
    cases: list[Path],
    *,
    out: Path,
    preset: str = "fast",
    seed: int = 0,
    weights: Path | None = None,
    jobs: int = 1,
    again: bool = False,
    require_trust: bool = False,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
) -> int:
    """Register many cases, several at a time, and write one table of what became of them.

    The run of each case is written to OUT/NAME, where NAME is that of its folder, as `femoreg register` writes it, as
    soon as it is done. Started again after it was killed, the command goes on with the cases that are missing: what
    was registered by the same versions and seed, and from files of the same content (case, CT, images, models, plan,
    preset, weights, wherever they lie), is kept. A case that is refused does not stop the others. OUT/table.csv tells
    the cases of this command. Status 2 if a case was refused or failed.

    Args:
        cases: Case folders, each with case.yaml.
        out: Folder of the runs and of the table.
        preset: Workflow, as for `femoreg register`.
        seed: Of the random searches.
        weights: Weights of the landmark network, if not those shipped.
        jobs: Cases at the same time. The cores are shared among them; each needs some 2 GB of memory.
        again: Register all cases anew.
        require_trust: End with status 3 if a result is not trusted.
        device: Where to compute, as for `femoreg register`; all jobs share one GPU.
    """
    import os

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes to come, as `femoreg register` has it
    from rich.console import Console

    from femoreg_torch.commands.status import BAD_INPUT, DONE, NOT_TRUSTED
    from femoreg_torch.commands.telling import progress_report, tell_device
    from femoreg_torch.files import clear_leftovers, only_writer

    console = Console()
    waiting = _jobs(cases, out, preset, seed, weights, jobs, tell_device(console, device).type)
    out.mkdir(parents=True, exist_ok=True)
    with only_writer(out), progress_report(console, "looking for earlier runs") as report:
        clear_leftovers(out)
        rows = {} if again else {job.case: row for job in waiting if (row := kept(job)) is not None}
        left = [job for job in waiting if job.case not in rows]
        report(f"{len(left)} cases", 0)
        for done, (job, row) in enumerate(run_jobs(left, jobs), 1):
            rows[job.case] = row
            told = f"{done} of {len(left)}: {row.case} {row.status}"
            if console.is_interactive:
                report(told, done / len(left))
            else:  # a log shows no bar, and is told of every case
                console.print(told, markup=False, highlight=False, soft_wrap=True)
            _write_table([rows[job.case] for job in waiting if job.case in rows], out / "table.csv")
        table = [rows[job.case] for job in waiting]
        _write_table(table, out / "table.csv")
    _tell(console, table)
    console.print(f"Table written to {out / 'table.csv'}.", markup=False)
    if any(row.status in _NO_RESULT for row in table):
        return BAD_INPUT
    return NOT_TRUSTED if require_trust and not all(row.trusted for row in table) else DONE


def _jobs(
    cases: Sequence[Path], out: Path, preset: str, seed: int, weights: Path | None, count: int, device: str
) -> list[Job]:
    """What is to be done. Raises `InputError` for what would be refused case by case, or written where it must not be.

    That is a preset or weights that cannot be read, cases of one name, no jobs, and a place for the runs that is a file
    or lies in a case.
    """
    import os

    from femoreg_torch.case.reading import CASE_NAME
    from femoreg_torch.detect import load_network
    from femoreg_torch.errors import InputError, shortened
    from femoreg_torch.files import check_folder
    from femoreg_torch.registration import load_plan

    if count < 1:
        raise InputError(f"--jobs: at least 1 was expected, got {count}.")
    # a case.yaml stands for its folder; what is none is told in its row
    cases = [case.parent if case.name == CASE_NAME and case.is_file() else case for case in cases]
    check_folder(out, cases)
    load_plan(preset)  # complains once, not for every case
    if weights is not None:
        load_network(weights)
    names = [case.resolve().name for case in cases]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{names.count(name)} cases are called {shortened(name)}: their runs would be one folder. Rename them."
            )
    threads = max(1, len(os.sched_getaffinity(0)) // count)
    waiting = [
        Job(case, out / name, preset, seed, weights, threads, device) for case, name in zip(cases, names, strict=True)
    ]
    for job in waiting:
        check_folder(job.out, [job.case])
    return waiting


def kept(job: Job) -> Row | None:
    """The row of a run that is there already; None if it is to be made, as it was made of other files or settings."""
    from femoreg_torch.case import RESULT_NAME, read_case, read_result
    from femoreg_torch.commands.register import inputs_of
    from femoreg_torch.errors import InputError
    from femoreg_torch.registration.run import versions

    if not (job.out / RESULT_NAME).is_file():
        return None
    try:
        result = read_result(job.out)
        if (result.preset, result.seed, result.versions) != (job.preset, job.seed, versions()):
            return None
        inputs = inputs_of(read_case(job.case), job.preset, job.weights)
    except InputError:
        return None  # a result of another version, or broken: it is made anew; of a broken case its run tells
    return _row(job, "kept", result) if result.inputs == inputs else None


def run_jobs(waiting: Sequence[Job], count: int, run: Callable[[Job], Row] | None = None) -> Iterator[tuple[Job, Row]]:
    """Run `run`, by default `run_job`, in `count` processes at a time; each job is told when it is done.

    Where a process is killed, those that ran beside it are begun anew, one after another; a case that ends its process
    again is told as failed.
    """
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    def attempt(some: Sequence[Job], at_once: int) -> Iterator[tuple[Job, Row | None]]:
        with ProcessPoolExecutor(at_once, get_context("spawn"), end_with_parent) as pool:
            running = {pool.submit(run or run_job, job): job for job in some}
            try:
                for future in as_completed(running):
                    try:
                        yield running[future], future.result()
                    except BrokenProcessPool:
                        yield running[future], None
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    lost = []
    for job, row in attempt(waiting, count) if waiting else ():
        if row is None:
            lost.append(job)
        else:
            yield job, row
    for job in lost:
        for _, row in attempt([job], 1):
            yield job, row or _bad(job, "failed", "its process was killed, perhaps for lack of memory", 0.0)


def end_with_parent() -> None:
    """End this process when the one that started it is gone, killed say; it would wait for work for ever."""
    import os
    from multiprocessing import parent_process
    from threading import Thread

    parent = parent_process()
    assert parent is not None  # called in processes that another one started

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def run_job(job: Job) -> Row:
    """Register one case in this process; what goes wrong becomes a row."""
    import time

    import numba
    import torch

    from femoreg_torch.case import read_case
    from femoreg_torch.commands.register import register_into
    from femoreg_torch.errors import InputError, defect_in_one_line

    threads = min(job.threads, numba.config.NUMBA_NUM_THREADS)  # the environment may allow fewer than there are cores
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)  # or its kernels take all cores, and torch's next ones with them
    began = time.perf_counter()
    try:
        device = torch.device(job.device)
        case = read_case(job.case)
        result, _ = register_into(job.out, case, job.preset, job.seed, weights=job.weights, device=device)
    except (InputError, OSError) as error:
        return _bad(job, "refused", " ".join(str(error).split()), time.perf_counter() - began)
    except Exception as error:  # a defect: told with its place, and the other cases go on
        return _bad(job, "failed", defect_in_one_line(error), time.perf_counter() - began)
    return _row(job, "done", result)


def _bad(job: Job, status: str, reason: str, seconds: float) -> Row:
    return Row(job.out.name, status, False, reason, seconds, {})


def _row(job: Job, status: str, result: "Result") -> Row:
    verdict = result.verdict
    errors: dict[str, float] = {}
    for name, value in (result.errors or {}).items():
        if isinstance(value, dict):
            errors |= {f"{name}_mm": value["mm"], f"{name}_deg": value["deg"]}
        else:
            errors[name] = value
    reasons = "" if verdict.trusted else "; ".join(verdict.reasons)
    return Row(job.out.name, status, verdict.trusted, reasons, result.timings_s.get("total", 0.0), errors)


def _write_table(rows: Sequence[Row], path: Path) -> None:
    import csv

    from femoreg_torch.files import temporary_file

    names = list(dict.fromkeys(name for row in rows for name in row.errors))
    with temporary_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["case", "status", "trusted", "seconds", *names, "reasons"])
        for row in rows:
            errors = [f"{row.errors[name]:.4f}" if name in row.errors else "" for name in names]
            trusted = "" if row.status in _NO_RESULT else str(row.trusted).lower()
            writer.writerow([row.case, row.status, trusted, f"{row.seconds:.1f}", *errors, row.reasons])


def _tell(console: "Console", rows: Sequence[Row]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("case", "run", "trusted", "s", "why not")
    for row in rows:
        trusted = "[green]yes[/]" if row.trusted else "–" if row.status in _NO_RESULT else "[bold red]no[/]"
        table.add_row(escape(row.case), row.status, trusted, f"{row.seconds:.0f}", escape(row.reasons))
    console.print(table)
