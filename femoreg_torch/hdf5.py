"""The one door for HDF5: files are read by a process of their own, which may crash or be stopped.

In a damaged file the HDF5 library may follow an entry of size 0 for ever, and nothing in Python can stop a loop in C.
So a child process opens the file and answers one question at a time, within limits of time and memory that the system
keeps. If it ends, the file is refused. It is forked: that costs some milliseconds, where a new process would import for
half a second. Answers are JSON, and arrays plain bytes.
"""

import faulthandler
import json
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, defect_in_one_line
from femoreg_torch.hdf5_entries import QUESTIONS, opened
from femoreg_torch.paths import check_readable

_LEAST_CPU_S, _SLOWEST = 2, 10 * 2**20  # for a question: seconds, and one more for so many bytes of the file
_SHARE_OF_MEMORY = 0.5


class Hdf5File:
    """An HDF5 file that a child process has open. All methods raise `InputError` for what the file does not hold."""

    def __init__(self, path: Path, child: Connection) -> None:
        self._path, self._child = path, child

    def there(self, name: str) -> bool:
        """Whether the file holds something of this name."""
        return bool(self._ask("there", name))

    def names(self, group: str) -> list[str]:
        """Names of the entries of a group, in order; `/` is the whole file."""
        return list(self._ask("names", group))

    def shape(self, name: str, ndim: int) -> tuple[int, ...]:
        """The shape of a data set of numbers with so many axes, none of them empty."""
        return tuple(self._ask("shape", name, ndim))

    def numbers(self, name: str, ndim: int, at: int | None = None, finite: bool = True) -> Any:
        """The numbers of a data set with so many axes, or those at place `at` of its first axis, as an array.

        Where they should be `finite`, NaN and infinity are refused.
        """
        return self._ask("numbers", name, ndim, at, finite)

    def scalar(self, name: str) -> float:
        """A finite number, alone or in lists of one."""
        return float(self._ask("scalar", name))

    def whole(self, name: str, low: int, high: int) -> int:
        """A whole number from `low` to `high`."""
        return int(self._ask("whole", name, low, high))

    def text(self, name: str) -> str:
        """A word."""
        return str(self._ask("text", name))

    def matrix(self, name: str, shape: tuple[int, ...]) -> Tensor:
        """Finite numbers of this shape, float64; a vector (n,) may stand as a column. Raises `InputError`."""
        return torch.from_numpy(self._ask("matrix", name, shape).copy())

    def listed(self, name: str, most: int) -> list[float]:
        """At most so many finite numbers, perhaps none."""
        return list(self._ask("listed", name, most))

    def _ask(self, question: str, *arguments: Any) -> Any:
        try:
            self._child.send_bytes(json.dumps([question, *arguments]).encode())
            kind, value = json.loads(self._child.recv_bytes())
            content = self._child.recv_bytes() if kind == "array" else b""
        except (EOFError, OSError) as error:
            raise InputError(
                f"{self._path}: the HDF5 library crashes on it or comes to no end. It is damaged: export it anew."
            ) from error
        if kind == "refused":
            raise InputError(value)
        if kind == "defect":
            raise RuntimeError(value)
        return np.frombuffer(content, value["dtype"]).reshape(value["shape"]) if kind == "array" else value


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5File]:
    """An HDF5 file for reading. Raises `InputError` if it is missing, or, when it is asked, is something else."""
    check_readable(Path(path))
    ours, theirs = Pipe()
    with quiet():  # Python warns of forks beside threads; the child has no need of them
        child = os.fork()
    if child == 0:
        try:
            ours.close()
            _answer(Path(path), theirs)
        finally:
            os._exit(0)
    theirs.close()
    try:
        yield Hdf5File(path, ours)
    finally:
        ours.close()
        os.kill(child, signal.SIGKILL)  # it only reads
        os.waitpid(child, 0)


def _answer(path: Path, parent: Connection) -> None:
    """In the child: answer what is asked until the parent has gone."""
    faulthandler.disable()  # what a crash prints helps nobody here
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to handle
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
    _limit(resource.RLIMIT_CORE, 0)
    _limit_memory()
    file = None
    while True:
        try:
            question, *arguments = json.loads(parent.recv_bytes())
        except (EOFError, OSError):
            return
        content = None
        try:
            _limit_time(path)
            file = file or opened(path)
            kind, value = "value", QUESTIONS[question](file, *arguments, path)
            if isinstance(value, np.ndarray):
                content = np.ascontiguousarray(value).reshape(-1).view(np.uint8)
                kind, value = "array", {"dtype": value.dtype.str, "shape": value.shape}
        except (InputError, OSError) as error:  # OSError: a file that has gone meanwhile
            kind, value = "refused", str(error)
        except MemoryError:
            kind, value = "refused", f"{path}: asks for more memory than there is. It may be damaged: export it anew."
        except Exception as error:  # raised again in the parent
            kind, value = "defect", defect_in_one_line(error)
        parent.send_bytes(json.dumps([kind, value]).encode())
        if content is not None:
            parent.send_bytes(content.data)


def _limit_time(path: Path) -> None:
    """Of the processor, from now on: a slow disk or a busy machine does not count."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _limit(resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime + path.stat().st_size / _SLOWEST) + _LEAST_CPU_S + 1)


def _limit_memory() -> None:
    """Beside what the parent has, which the child shares."""
    sizes = Path("/proc/self/statm")
    if sizes.exists():  # Linux
        pages = int(sizes.read_text(encoding="utf-8").split()[0]) + int(_SHARE_OF_MEMORY * os.sysconf("SC_PHYS_PAGES"))
        _limit(resource.RLIMIT_AS, pages * os.sysconf("SC_PAGE_SIZE"))


def _limit(what: int, most: int) -> None:
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
