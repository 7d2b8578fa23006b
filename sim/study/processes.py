"""Work of several processes on this machine, on one core each (joblib, loky)."""

import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from joblib import Parallel, parallel_config

# What loky says when it has replaced a process that had grown or was idle: nothing is lost by that.
_REPLACED = "A worker stopped while some jobs were given to the executor"


def in_processes(jobs: int, tasks: Iterable[Any]) -> Iterator[Any]:
    """Results of `joblib.delayed` calls, as they are done. With one job, this process does them.

    Raises `TerminatedWorkerError` if a process is killed: all others end with it.
    """
    with warnings.catch_warnings(), parallel_config(backend="loky", inner_max_num_threads=1):
        warnings.filterwarnings("ignore", _REPLACED, UserWarning)
        yield from Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks)
