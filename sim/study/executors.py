"""Where the batches of a study are done: in processes of this machine (joblib, loky), or on a cluster (Dask)."""

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from joblib import delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from femoreg_torch.errors import InputError
from sim.study.engine import Work, give_up, perform
from sim.study.processes import in_processes
from sim.study.store import Batch, Store

PATIENCE = "10s"  # with a scheduler that does not answer
_NEEDED = ("dask", "distributed", "cloudpickle", "msgpack", "numpy")  # of those that Dask tells the versions of
_OURS = ("femoreg_torch", "torch")


@dataclass(frozen=True)
class OnThisMachine:
    """So many processes, each on one core; with one, this process does it all."""

    jobs: int

    def __call__(self, work: Work, store: Store, todo: Sequence[Batch], done: Callable[[Batch], None]) -> None:
        """Where a process is killed, all are; those that may have been the cause are then tried again one by one."""
        left = {batch.procedure.number: batch for batch in todo}
        while left:
            before = len(left)
            try:
                self._all_at_once(work, store, left, done)
            except TerminatedWorkerError:
                suspects = store.clear_killed() & left.keys()
                if not suspects and len(left) == before:
                    raise
                for number in sorted(suspects):
                    self._alone(work, store, left.pop(number), done)

    def _all_at_once(self, work: Work, store: Store, left: dict[int, Batch], done: Callable[[Batch], None]) -> None:
        tasks = (delayed(_perform)(work, store, batch) for batch in list(left.values()))
        for number in in_processes(self.jobs, tasks):
            done(left.pop(number))

    def _alone(self, work: Work, store: Store, batch: Batch, done: Callable[[Batch], None]) -> None:
        rest = batch
        while rest.runs:
            try:
                list(in_processes(2, [delayed(_perform)(work, store, rest)]))  # one process beside this one
                break
            except TerminatedWorkerError:
                store.clear_killed()
                rest = give_up(store, rest)
        done(batch)


@dataclass(frozen=True)
class OnCluster:
    """The workers of a Dask scheduler. They have to see the folder of the study under the same path."""

    address: str

    def __call__(self, work: Work, store: Store, todo: Sequence[Batch], done: Callable[[Batch], None]) -> None:
        """A batch whose worker dies is given to another; one that ends several of them is given up.

        Raises `InputError` if the scheduler does not answer or goes away, if it or a worker has other packages, or if
        its workers run several tasks at a time.
        """
        from distributed import Client, KilledWorker, as_completed

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of packages that differ, which is told below
                client = Client(self.address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler {self.address}: does not answer ({' '.join(str(error).split())}). Give the address that "
                "`dask scheduler` prints."
            ) from error
        with _quiet("distributed.client"), client:
            versions: Any = client.get_versions(packages=_OURS)  # no coroutine, as the client is none of asyncio
            _check_packages(versions, self.address)
            _check_workers(client.scheduler_info(n_workers=-1)["workers"], self.address)
            waiting = {client.submit(_perform, work, store, batch, pure=False): (batch, batch) for batch in todo}
            finished = as_completed(waiting, loop=client.loop)
            for future in finished:
                whole, batch = waiting.pop(future)
                if future.cancelled():
                    raise InputError(
                        f"--scheduler {self.address}: has gone. The runs that are done are kept: give the same command "
                        "again once it is there."
                    )
                failure = future.exception()
                if isinstance(failure, KilledWorker):
                    rest = give_up(store, batch)
                    if rest.runs:
                        again = client.submit(_perform, work, store, rest, pure=False)
                        waiting[again] = whole, rest
                        finished.add(again)
                        continue
                elif failure is not None:
                    raise failure
                done(whole)


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Without what a library logs of failures that its exceptions tell as well."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def _check_packages(versions: Mapping[str, Any], address: str) -> None:
    """Raises `InputError` where scheduler or a worker has another Python or other packages than this process.

    `versions` are those that `Client.get_versions` gives. What is sent could not be opened there, or would compute
    otherwise.
    """
    here = versions["client"]["packages"]
    places = {"the scheduler": versions["scheduler"]}
    places |= {f"the worker {name}": told for name, told in versions["workers"].items()}
    for place, told in places.items():
        there = told["packages"]
        differ = [
            f"{name} {there.get(name) or '(none)'} in place of {here[name]}"
            for name in ("python", *_NEEDED, *_OURS)
            if _release(name, there) != _release(name, here)
        ]
        if differ:
            raise InputError(
                f"--scheduler {address}: {place} has other packages than this machine: {', '.join(differ)}. Install "
                "the same ones there, by the same constraints.txt."
            )


def _release(name: str, packages: Mapping[str, str | None]) -> str | None:
    """What has to be equal: of Python, major and minor version."""
    found = packages.get(name)
    return ".".join(found.split(".")[:2]) if name == "python" and found else found


def _check_workers(workers: dict[str, dict[str, int]], address: str) -> None:
    for worker in workers.values():
        if worker["nthreads"] > 1:
            raise InputError(
                f"--scheduler {address}: a worker has {worker['nthreads']} threads, but a registration needs a process "
                "of its own. Start workers with `--nthreads 1 --nworkers N`."
            )


def _perform(work: Work, store: Store, batch: Batch) -> int:
    perform(work, store, batch)
    return batch.procedure.number
