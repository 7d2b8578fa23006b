"""Work shared out among the cores by threads: images, views and objects that do not wait for each other.

Compiled kernels and torch let other threads go on while they compute, so that threads keep all cores busy where each
kernel by itself is too short to be worth sharing out. A thread of this kind uses one core: what it computes does not
depend on how many there are.
"""

import functools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import torch

T = TypeVar("T")
R = TypeVar("R")

_CPU = torch.device("cpu")


def on_all_cores(function: Callable[[T], R], items: Sequence[T], device: torch.device = _CPU) -> list[R]:
    """What a function returns for each item, in their order; several items at a time, each on one core.

    As many at a time as numba has threads here: `numba.set_num_threads` and NUMBA_NUM_THREADS limit them. Items come
    one after the other within such a call, for what lies on another `device` than the CPU, and where numba's threads do
    not bear company (its layer `workqueue`). Raises what the function raises for the first item that it fails for.
    """
    cores = numba.get_num_threads()
    if cores < 2 or len(items) < 2 or device.type != "cpu" or not _bears_company():
        return [function(item) for item in items]
    return list(_threads(os.getpid(), cores).map(function, items))


def shares(count: int, device: torch.device = _CPU) -> list[slice]:
    """A batch of so many in parts for `on_all_cores`, two for each core, so that none waits long for another."""
    cores = numba.get_num_threads() if device.type == "cpu" else 1
    parts = 2 * cores if cores > 1 else 1
    size = max(1, -(-count // parts))
    return [slice(first, first + size) for first in range(0, max(1, count), size)]


@functools.cache
def _bears_company() -> bool:
    """Whether kernels may run in several threads at once: numba's own layer ends the process then."""
    numba.get_num_threads()  # chooses the layer
    return bool(numba.threading_layer() != "workqueue")


@functools.cache
def _threads(process: int, count: int) -> ThreadPoolExecutor:
    """So many threads of a process, each of which computes on one core; a forked process has its own."""
    pool, all_there, before = ThreadPoolExecutor(count, "core"), threading.Barrier(count), torch.get_num_threads()

    def use_one_core(_: int) -> None:
        numba.set_num_threads(1)
        torch.get_num_threads()  # the first call in a thread takes over the number of the others
        torch.set_num_threads(1)
        all_there.wait()  # or one thread would take the turns of several

    list(pool.map(use_one_core, range(count)))
    torch.set_num_threads(before)  # the last number that was set is that of threads to come
    return pool
