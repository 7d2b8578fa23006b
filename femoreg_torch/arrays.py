"""The one door for arrays: what a file claims is checked before anything is allocated, and libraries do not print.

A header of a few bytes may claim any number of voxels. OpenCV, ITK's MetaIO and GDCM write to the process' stderr what
their exceptions say as well, or what does not matter to anybody; pydicom, nibabel and trimesh warn and log.
"""

import logging
import math
import os
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from femoreg_torch.errors import InputError

MOST_VOXELS = 2**29  # of a volume: 512 × 512 × 2048
MOST_PIXELS = 2**26  # of an image: 8192 × 8192; OpenCV is told by the environment, see `femoreg_torch/__init__.py`
_MOST_INFLATED = 1032  # bytes out of one: the limit of deflate (zlib, technical details), which gzip uses
_HEADER = 2**16  # bytes of a file that may be header
_SHARE_OF_MEMORY = 0.5

for _name in ("nibabel.global", "pydicom", "trimesh", "PIL"):
    logging.getLogger(_name).setLevel(logging.CRITICAL)  # what they log before they raise


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """A file, open for reading bytes. Raises `InputError` with its name, which a failed read does not tell."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error


def check_voxels(shape: Sequence[int], where: str, hint: str) -> None:
    """Raises `InputError` that starts with `where` and ends with `hint` for more voxels than can be worked with."""
    count = math.prod(int(n) for n in shape)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    most = min(MOST_VOXELS, int(_SHARE_OF_MEMORY * memory / 4))  # of float32
    if count > most:
        told = " × ".join(str(int(n)) for n in shape)
        raise InputError(f"{where}: {told} voxels are more than the {most:.2g} that can be worked with. {hint}")


def check_claim(path: Path, shape: Sequence[int], bytes_each: int, there: int | None) -> None:
    """Raises `InputError` if a file claims more values than can be worked with, or than its bytes can hold.

    `shape` and `bytes_each`, the size of a value, are what its header says; `there` is how many bytes the file has,
    compressed or not, or None where the values stand in other files.
    """
    if min(shape, default=0) < 1:
        told = " × ".join(str(int(n)) for n in shape)
        raise InputError(f"{path}: its header claims {told or 'no'} values. Export it anew.")
    check_voxels(shape, str(path), "Crop or resample the volume, if the header is right.")
    claimed = math.prod(int(n) for n in shape) * bytes_each
    if there is not None and claimed > _MOST_INFLATED * there + _HEADER:
        raise InputError(
            f"{path}: its header claims {claimed} bytes of values, which {there} bytes cannot hold. The file is cut "
            "off or damaged: export or copy it anew."
        )


def check_pixels(path: Path, rows: int, columns: int) -> None:
    """Raises `InputError` if a file claims an image larger than any detector's."""
    if rows * columns > MOST_PIXELS:
        raise InputError(f"{path}: claims {rows} × {columns} pixels, but no detector has more than {MOST_PIXELS}.")


_lock = threading.Lock()
_inside = 0  # threads that are within `quiet`
_stderr = -1  # where the process' stderr went to before the first of them
_filters = warnings.catch_warnings()


@contextmanager
def quiet() -> Iterator[None]:
    """What libraries print on the process' stderr, and Python's warnings, go nowhere while a thread is within.

    What they have to say of a failure comes with their exceptions.
    """
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    global _inside, _stderr, _filters
    with _lock:
        if _inside == 0:
            _filters = warnings.catch_warnings()
            _filters.__enter__()
            warnings.simplefilter("ignore")
            _flush()
            _stderr = _silenced()
        _inside += 1


def _flush() -> None:
    if sys.stderr is not None:  # as it is in a process without one
        sys.stderr.flush()


def _silenced() -> int:
    """A copy of the process' stderr, which is then turned to nowhere; −1 where the process has none."""
    try:
        copy = os.dup(2)
    except OSError:
        return -1
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    return copy


def _leave() -> None:
    global _inside
    with _lock:
        _inside -= 1
        if _inside > 0:
            return
        _flush()
        if _stderr >= 0:
            os.dup2(_stderr, 2)
            os.close(_stderr)
        _filters.__exit__(None, None, None)
