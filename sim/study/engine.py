"""A study carried out: every run made once, whatever happens to the processes that make it.

What is run is told by a `Work`, so that the engine knows nothing of procedures but their numbers. Each record is
written by the process that made it, as soon as it is there; a command that is killed loses the runs in flight, no more.
"""

import errno
import os
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numba
import torch

from femoreg_torch.errors import defect_in_one_line
from femoreg_torch.registration.run import versions
from sim.study.procedures import Procedure
from sim.study.record import Record, outcome
from sim.study.store import FAILED, Batch, Run, Store

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_ROOM_BYTES = 100e6  # what a run writes; some libraries do not tell a full disk from other failures
Progress = Callable[[int], None]  # is told how many runs more are done


class Work(Protocol):
    """How runs are made. It is sent to the processes that make them, so it has to be picklable.

    Called with a procedure and a scratch folder, it gives a function that makes the record of any run on it. Whatever a
    record holds, `refused` says in it why there is no result (None: there is one).
    """

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], Record]: ...


class Executor(Protocol):
    """Where batches are done: hands each to `perform`, and calls `done` with every batch that is finished."""

    def __call__(self, work: Work, store: Store, todo: Sequence[Batch], done: Callable[[Batch], None]) -> None: ...


def carry_out(work: Work, store: Store, todo: Sequence[Batch], executor: Executor, progress: Progress) -> None:
    """Make all runs of the batches. Raises `OSError` if the disk is full; what is done stays done."""
    executor(work, store, todo, lambda batch: progress(len(batch.runs)))


def perform(work: Work, store: Store, batch: Batch) -> None:
    """Make the runs of one batch in this process, on one core, and keep each.

    A run that fails is kept with its reason and place, and the next one is made. Raises `OSError` if the disk is full.
    """
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    with store.scratch(batch.procedure.number) as scratch:
        make = work(batch.procedure, scratch)
        for run in batch.runs:
            if not _is_made(store, run):  # by a process that was killed after it
                store.write(run, _attempt(make, run, store.folder))


def give_up(store: Store, batch: Batch) -> Batch:
    """Keep the first run of a batch without a record of this code as failed, as it ends its process; the others stay.

    Returns what is left of the batch.
    """
    waiting = [run for run in batch.runs if not _is_made(store, run)]
    if waiting:
        reason = "its process was killed, perhaps for lack of memory"
        store.write(waiting[0], _about(waiting[0]) | _failed(reason))
    return Batch(batch.procedure, tuple(waiting[1:]))


def _is_made(store: Store, run: Run) -> bool:
    record = store.record(run)
    return record is not None and record["code"] == store.code and record["status"] != FAILED


def _attempt(make: Callable[[Run], Record], run: Run, folder: Path) -> Record:
    began = time.perf_counter()
    try:
        found = make(run)
    except Exception as error:  # a defect, or too little memory: told with its place, and the other runs go on
        if isinstance(error, OSError) and error.errno in DISK_FULL:
            raise
        if shutil.disk_usage(folder).free < _ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder)) from error
        found = _failed(defect_in_one_line(error))
    else:
        found = found | outcome(found)
    return _about(run) | found | {"run_s": time.perf_counter() - began}


def _about(run: Run) -> Record:
    """What every record holds, whatever became of its run."""
    return asdict(run.procedure) | {
        "kind": run.kind,
        "preset": run.preset,
        "host": platform.node(),
        "versions": versions(),
    }


def _failed(reason: str) -> dict[str, Any]:
    return {"status": FAILED, "reason": reason, "refused": reason, "trusted": False, "reasons": []}
