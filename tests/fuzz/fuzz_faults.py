"""Disks that fail at the n-th step of writing, or are full after so many bytes.

Python tells of each call to the system before it is made (audit hooks, PEP 578); there the n-th one that writes fails.
"""

import errno
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_WRITING = ("os.rename", "os.mkdir", "os.link", "os.chmod", "shutil.copyfile", "shutil.copytree", "tempfile.mkdtemp")
_TWO_PLACES = ("os.rename", "os.link", "shutil.copyfile", "shutil.copytree", "shutil.move")


class _Fault:
    """Lets the n-th call that writes below a folder fail; told by the interpreter, so it stays installed for good."""

    def __init__(self) -> None:
        self.folder, self.left = "", 0

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.left <= 0 or not self._writes(event, arguments):
            return
        self.left -= 1
        if self.left == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))

    def _writes(self, event: str, arguments: tuple[Any, ...]) -> bool:
        if event == "open":
            writes = isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        else:
            writes = event in _WRITING
        places = arguments[:2] if event in _TWO_PLACES else arguments[:1]
        return bool(writes) and any(str(place).startswith(self.folder) for place in places)


FAULT = _Fault()
sys.addaudithook(FAULT)


@contextmanager
def fault(folder: Path, n: int) -> Iterator[None]:
    """The n-th call that writes below `folder` fails."""
    FAULT.folder, FAULT.left = str(folder), n
    try:
        yield
    finally:
        FAULT.left = 0


@contextmanager
def full_after(size: int) -> Iterator[None]:
    """No file can be longer than so many bytes, whoever writes it, as on a disk that becomes full there."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
