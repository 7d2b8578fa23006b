"""What stands in an HDF5 file: claims are checked before they are read, and what h5py raises becomes one line.

A data set may claim any size without having a byte, keep its values in other files, or hold texts and records. These
functions of an open file are called in a process of their own, see `hdf5`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from femoreg_torch.arrays import check_claim
from femoreg_torch.errors import InputError, shortened

_LONGEST_TEXT = 200  # bytes of a name or a word


@contextmanager
def _reading(path: Path, name: str) -> Iterator[None]:
    """What h5py raises while a part of a file is read, of some ten kinds, becomes an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError, MemoryError) as error:
        raise InputError(
            f"{path}, {shortened(name)}: cannot be read, the file is damaged or something else ({shortened(error)})."
        ) from error


def opened(path: Path) -> Any:
    """An HDF5 file for reading. Raises `InputError` if it is something else."""
    try:
        return h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as HDF5; the file is damaged or something else.") from error


def there(file: Any, name: str, path: Path) -> bool:
    """Whether a file holds something of this name."""
    with _reading(path, name):
        return name in file


def names(file: Any, group: str, path: Path) -> list[str]:
    """Names of the entries of a group, in order; `/` is the whole file. Raises `InputError` where there is none."""
    with _reading(path, group):
        if group not in file or not isinstance(file[group], h5py.Group):
            raise InputError(f"{path}: the group `{group}` is missing.")
        return sorted(map(str, file[group]))


def _entry(file: Any, name: str, path: Path) -> Any:
    """The data set of a name, whose values stand in the file itself."""
    if name not in file or not isinstance(file[name], h5py.Dataset):
        raise InputError(f"{path}: `{name}` is missing.")
    found = file[name]
    if found.is_virtual or found.external:
        raise InputError(f"{path}, {name}: keeps its values in other files. Copy them into this one.")
    if found.shape is None:
        raise InputError(f"{path}, {name}: is empty.")
    return found


def shape(file: Any, name: str, ndim: int, path: Path) -> tuple[int, ...]:
    """The shape of a data set of numbers with so many axes. Raises `InputError` for another one, and an empty one."""
    with _reading(path, name):
        found = _entry(file, name, path)
        if found.ndim != ndim or found.dtype.kind not in "buif" or 0 in found.shape:
            kind = f"{' × '.join(map(str, found.shape)) or 'one'} of type {found.dtype}"
            raise InputError(f"{path}, {name}: numbers with {ndim} axes were expected, found {kind}.")
        return tuple(int(n) for n in found.shape)


def numbers(file: Any, name: str, ndim: int, at: int | None, finite: bool, path: Path) -> Any:
    """The numbers of a data set with so many axes, or those at place `at` of its first axis.

    Raises `InputError` for texts and records, another shape, more than the file can hold, and, where they should be
    `finite`, for NaN and infinity.
    """
    known = shape(file, name, ndim, path)
    with _reading(path, name):
        found = file[name]
        # compressed by whatever filter; values that were never written take no byte, and are none
        check_claim(path, known if at is None else known[1:], found.dtype.itemsize, Path(path).stat().st_size)
        values = np.asarray(found[...] if at is None else found[at])
    if finite and values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{path}, {name}: finite numbers were expected, found NaN or infinity.")
    return values


def scalar(file: Any, name: str, path: Path) -> float:
    """A finite number, alone or in lists of one."""
    with _reading(path, name):
        found = _entry(file, name, path)
        if found.size == 1 and found.dtype.kind in "buif" and np.isfinite(value := float(np.asarray(found).ravel()[0])):
            return value
    raise InputError(f"{path}, {name}: one number was expected.")


def whole(file: Any, name: str, low: int, high: int, path: Path) -> int:
    """A whole number from `low` to `high`."""
    value = scalar(file, name, path)
    if value != int(value) or not low <= value <= high:
        raise InputError(f"{path}, {name}: a whole number from {low} to {high} was expected, found {value:g}.")
    return int(value)


def text(file: Any, name: str, path: Path) -> str:
    """A word."""
    with _reading(path, name):
        found = _entry(file, name, path)
        if found.size == 1 and found.dtype.itemsize <= _LONGEST_TEXT:
            value = np.asarray(found[()], dtype=object).ravel()[0]
            if isinstance(value, bytes | str) and len(value) <= _LONGEST_TEXT:
                return value.decode() if isinstance(value, bytes) else value
    raise InputError(f"{path}, {name}: a word was expected.")


def matrix(file: Any, name: str, shape: Sequence[int], path: Path) -> Any:
    """Finite numbers of a shape, float64; vectors may stand as a column."""
    with _reading(path, name):
        found = _entry(file, name, path)
        column = len(shape) == 1 and found.size == shape[0]
        fits = found.dtype.kind in "buif" and (column or found.shape == tuple(shape))
        values = np.asarray(found, dtype=np.float64).reshape(shape) if fits else np.empty(0)
        if not fits or not np.isfinite(values).all():
            expected = " × ".join(map(str, shape))
            raise InputError(f"{path}, {name}: {expected} finite numbers were expected, found {found.shape}.")
    return values


def listed(file: Any, name: str, most: int, path: Path) -> list[float]:
    """At most so many finite numbers, perhaps none."""
    with _reading(path, name):
        found = _entry(file, name, path)
        if found.dtype.kind not in "buif" or found.size > most:
            raise InputError(f"{path}, {name}: at most {most} numbers were expected.")
        values = np.asarray(found, dtype=np.float64).ravel()
        if not np.isfinite(values).all():
            raise InputError(f"{path}, {name}: its numbers are not all finite.")
    return values.tolist()


# what a process that has a file open can be asked; the file comes first, then a name and so on, the path last
QUESTIONS: dict[str, Callable[..., Any]] = {
    question.__name__: question for question in (there, names, shape, numbers, scalar, whole, text, matrix, listed)
}
