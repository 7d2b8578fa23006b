"""Two paths exchanged in one step, by Linux' `renameat2` (rename(2)); Python's `os` has no function for it."""

import ctypes
import errno
import os
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h, linux/fs.h
_NOT_AVAILABLE = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP}  # an old kernel; a file system that has no exchange


def exchange(first: Path, second: Path) -> bool:
    """Exchange two existing files or folders of one file system, so that no moment shows one without the other.

    Returns False, with nothing done, where system or file system cannot. Raises `OSError` as a rename does.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):  # no Linux, or a C library without it
        return False
    if library.renameat2(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NOT_AVAILABLE:
        return False
    raise OSError(number, os.strerror(number), str(first), None, str(second))
