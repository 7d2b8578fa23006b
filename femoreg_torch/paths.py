"""Why a path cannot be read as a file: the one place that tells it, for whatever a user names."""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Literal

from femoreg_torch.errors import InputError, shortened

Expected = Literal["file", "folder", "file or folder"]

_MOST_NAMES = 5000  # of a folder, among which similar ones are looked for
_OFFERED = 3  # similar names in a message
_LONGEST_NAME = 80  # characters of a name that is offered
_LONGEST_PATH = 500  # characters of a path that is told whole
_ALIKE = 0.65  # of difflib's measure, 1 for the same name


def check_readable(path: Path, hint: str = "", expected: Expected = "file") -> None:
    """Raises `InputError` that starts with the path and says why it cannot be read; see `why_unreadable`."""
    if (why := why_unreadable(path, hint, expected)) is not None:
        told = str(path) if len(str(path)) <= _LONGEST_PATH else shortened(path, 200)
        raise InputError(f"{told}: {why}")


def why_unreadable(path: Path, hint: str = "", expected: Expected = "file") -> str | None:
    """Why a path is not the file or folder that was expected, or cannot be read, and how to mend it; None if it can.

    What is missing is told with the most similar names in its folder, and with `hint`, a sentence. An empty file cannot
    be read.
    """
    try:
        kind = path.stat().st_mode
        if stat.S_ISDIR(kind) and expected != "file":
            with os.scandir(path):
                return None
        if stat.S_ISREG(kind) and expected != "folder":
            with path.open("rb") as file:
                return None if file.read(1) else "is empty (0 bytes). Copy or export it anew."
    except (FileNotFoundError, NotADirectoryError):
        return f"{_missing(path, expected)} {hint}".rstrip()
    except PermissionError:
        return "you have no permission to read it. Give it to yourself (`chmod`), or copy it to a folder of yours."
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        return f"cannot be read ({reason})."
    if stat.S_ISDIR(kind):
        return f"is a folder, a {expected} was expected. Name a file in it."
    if stat.S_ISREG(kind):
        return f"is a file, a {expected} was expected. {hint}".rstrip()
    return f"is a device or a pipe, a {expected} was expected. Save what it gives as a file."


def _missing(path: Path, kind: Expected) -> str:
    """What is missing of a path: the last step of it, or the first folder on the way that is not there."""
    if path.is_symlink():
        return f"is a link to {shortened(path.readlink(), _LONGEST_NAME)}, which is not there."
    if "\\" in str(path) and (there := Path(str(path).replace("\\", "/"))).exists():
        return f"no such {kind}. Did you mean {there}? Write / in place of \\."
    way = (path, *path.parents)
    last = next(number for number, step in enumerate(way) if number and step.exists())
    if not way[last].is_dir():
        return f"no such {kind}: {way[last]} is a file, no folder."
    first = way[last - 1]
    absent = "." if first == path else f": there is no folder {first}."
    return f"no such {kind}{absent}{_did_you_mean(first)}"


def _did_you_mean(path: Path) -> str:
    """A question that names what is most like a missing path in its folder; nothing if nothing is."""
    names = list(_similar(path))
    if not names:
        return ""
    return f" Did you mean {', '.join(names[:-1])}{' or ' if len(names) > 1 else ''}{names[-1]}?"


def _similar(path: Path) -> Iterator[str]:
    there: dict[str, str] = {}
    with suppress(OSError), os.scandir(path.parent) as entries:
        for entry in islice(entries, _MOST_NAMES):
            if not entry.name.startswith(".") and len(entry.name) <= _LONGEST_NAME:
                there[entry.name.casefold()] = entry.name
    meant = path.name.casefold()
    stem = meant.partition(".")[0]
    alike = [name for name in sorted(there) if stem and name.partition(".")[0] == stem]  # `ct.nii` for `ct.nii.gz`
    alike += [name for name in get_close_matches(meant, sorted(there), _OFFERED, _ALIKE) if name not in alike]
    return (there[name] for name in alike[:_OFFERED])
