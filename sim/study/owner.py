"""Whose a folder is, told by a file in it: no locks, which some file systems do not have.

The file is made by O_EXCL, so that of two processes one makes it, also on NFS. On its own machine a process is known by
its number and start. One of another machine is taken for gone when its file has not been touched for two minutes.
"""

import json
import os
import platform
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json

NAME = ".owner"
BEAT_S, GONE_S = 15.0, 120.0
_LEFT_S = 86400.0  # no run takes a day
_TRIES, _PAUSE_S = 20, 0.1  # to take over from one that is gone, while others try too

Owner = dict[str, Any]


@contextmanager
def owning(folder: Path) -> Iterator[None]:
    """Raises `InputError` if a process that may be alive owns the folder. While the block lasts, this one does."""
    path, mine = folder / NAME, _this_process()
    _claim(path, mine)
    done = threading.Event()
    beating = threading.Thread(target=_beat, args=(path, done), daemon=True)
    beating.start()
    try:
        yield
    finally:
        done.set()
        beating.join()
        if _read(path) == mine:
            path.unlink()


def mark(folder: Path) -> None:
    """Say in a folder of its own that it is this process's."""
    _make(folder / NAME, _this_process())


def is_left(folder: Path) -> bool:
    """Whether the process that has marked a folder is gone; of one of another machine, whether that was a day ago."""
    owner = _read(folder / NAME)
    if owner is not None and owner["machine"] == _machine():
        return not _is_alive(owner)
    return _older_than(folder, _LEFT_S)


def _this_process() -> Owner:
    process = psutil.Process()
    return {
        "machine": _machine(),
        "host": platform.node(),
        "process": process.pid,
        "started": process.create_time(),
        "token": uuid.uuid4().hex,
    }


def _machine() -> str:
    """The host, and where numbers of processes count by container, that too."""
    try:
        return f"{platform.node()} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:  # not Linux
        return platform.node()


def _is_alive(owner: Owner) -> bool:
    """Of a process of this machine. A process that has ended, but not been asked for its status, is gone."""
    try:
        process = psutil.Process(owner["process"])
        return abs(process.create_time() - owner["started"]) < 1 and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _claim(path: Path, mine: Owner) -> None:
    for _ in range(_TRIES):
        try:
            _make(path, mine)
            return
        except FileExistsError:
            theirs = _read(path)
            if not _is_gone(path, theirs):
                raise InputError(_refusal(path, theirs)) from None
            _remove(path, theirs)
    raise InputError(f"{path.parent}: others take it over at the same time. Give the command again.")


def _make(path: Path, owner: Owner) -> None:
    with path.open("x", encoding="utf-8") as file:  # O_CREAT | O_EXCL
        try:
            file.write(json.dumps(owner))
            file.flush()
        except OSError:  # a full disk
            path.unlink()
            raise


def _read(path: Path) -> Owner | None:
    """None if the file is not there, or not whole yet."""
    try:
        found: Owner = read_json(path)
    except InputError:
        return None
    return found


def _is_gone(path: Path, owner: Owner | None) -> bool:
    if owner is not None and owner["machine"] == _machine():
        return not _is_alive(owner)
    return _older_than(path, GONE_S)


def _older_than(path: Path, seconds: float) -> bool:
    """By the clock of the file system, which need not be that of this machine; True of what is not there any more."""
    with suppress(FileNotFoundError), tempfile.NamedTemporaryFile(dir=path.parent) as now:
        return os.fstat(now.fileno()).st_mtime - path.stat().st_mtime > seconds
    return True


def _remove(path: Path, theirs: Owner | None) -> None:
    """Take away the file of one that is gone, unless another does so just now or has taken over since."""
    guard = path.with_name(f"{NAME}.taking")
    try:
        guard.open("x").close()
    except FileExistsError:
        if _older_than(guard, GONE_S):  # of one that was killed right here
            guard.unlink(missing_ok=True)
        time.sleep(_PAUSE_S)
        return
    try:
        if _read(path) == theirs:
            path.unlink(missing_ok=True)
    finally:
        guard.unlink()


def _refusal(path: Path, owner: Owner | None) -> str:
    who = "" if owner is None else f" (process {owner['process']} on {owner['host']})"
    return (
        f"{path.parent}: another command is writing there{who}. Wait, or choose another --out. If it was killed on "
        f"another machine, wait for {GONE_S / 60:g} minutes."
    )


def _beat(path: Path, done: threading.Event) -> None:
    while not done.wait(BEAT_S):
        with suppress(OSError):  # one beat that fails is no harm, and of a full disk the runs tell
            os.utime(path)
