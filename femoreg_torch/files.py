"""Files and folders that appear whole or not at all, whatever happens to the run that writes them; JSON."""

import errno
import fcntl
import glob
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.exchange import exchange
from femoreg_torch.text import MOST_JSON_BYTES, json_content, read_bytes

_RANDOM_PART = "????????"  # of a name by tempfile.mkdtemp
_SUFFIX = ".part"
_LONGEST_NAME = 240  # bytes; Linux allows 255, and the hidden folder beside has a name that is longer by 15
NO_ROOM = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT}  # what the system says of a full disk
_MOST_NEW = 50  # folders that are made for one that is asked for; Python makes them by recursion
_LOCK, _NEW, _OLD = "lock", "new", "old"  # what a workshop holds: a lock, what is being written, what it replaces


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """A path of the same name in a hidden folder beside `path`; what the caller writes there is renamed to `path`.

    If the block fails, `path` is as it was. Raises `InputError` as `check_files` does.
    """
    check_files(path)
    with _workshop(path) as workshop:
        part = workshop / _NEW / path.name
        yield part
        part.replace(path)


@contextmanager
def temporary_files(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Like `temporary_file`, for files of one folder that belong together: all of them are new, or all are as before.

    The others describe the first. A run that is killed just while they are renamed leaves the first, old or new,
    without some of the others, and never beside what describes another.
    """
    check_files(*paths)
    with _workshop(paths[0]) as workshop:
        parts = tuple(workshop / _NEW / path.name for path in paths)
        yield parts
        aside = workshop / "aside"
        aside.mkdir()
        there = [path for path in paths if os.path.lexists(path)]
        try:
            for path in there:
                (_link if path == paths[0] else os.rename)(path, aside / path.name)
            for part, path in zip(parts, paths, strict=True):
                part.replace(path)
        except BaseException:
            for path in paths:
                if os.path.lexists(aside / path.name):
                    (aside / path.name).replace(path)
                elif path not in there:
                    path.unlink(missing_ok=True)
            raise


def check_suffix(path: Path, suffixes: Sequence[str]) -> None:
    """Raises `InputError` for a name that does not end in one of `suffixes`, by which a file is recognised later."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: a name that ends in {' or '.join(suffixes)} was expected.")


def check_files(*paths: Path) -> None:
    """Raises `InputError` where no file of such a name can be; for commands that compute long before they write."""
    for path in paths:
        if len(os.fsencode(path.name)) > _LONGEST_NAME:
            raise InputError(f"{shortened(path, 200)}: this name is too long. Choose another one.")
        if not path.parent.is_dir():
            raise InputError(f"{path}: cannot be written, there is no folder {path.parent}. Make it first.")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is there and is no file, so it is not replaced. Choose another name.")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise InputError(
                f"{path}: cannot be written, {path.parent} is read-only or not yours. Choose another place."
            )


@contextmanager
def new_folder(path: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """An empty folder to be filled, which takes the place of `path` when the block ends without an exception.

    If `path` exists already, its entries stay, but for those that were written anew (a folder as a whole) and those
    whose names are in `without`. Old and new folder are exchanged in one step: a run that is killed leaves all of the
    old or all of the new. Files that stay are linked, not copied, where the file system can. If the block fails,
    nothing of `path` has changed.

    Where a system or file system cannot exchange two folders (other than Linux; NFS), the old one is renamed away and
    the new one in: a run that is killed between the two leaves no `path`, and the next writer brings the old back.

    As the folder is another one afterwards, a shell that stands in it has to enter it again (`cd .`).

    Raises `InputError` if `path` is a file, or cannot be renamed because it is a mount point.
    """
    path = check_new_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _workshop(path) as workshop:
        built = workshop / _NEW / path.name
        built.mkdir()
        yield built
        for left in list(built.rglob(f".*.{_RANDOM_PART}{_SUFFIX}")):  # of files in it: what could not be removed there
            shutil.rmtree(left)
        if path.exists():
            _keep_others(path, built, without)
        _put_in_place(built, path, workshop / _OLD)


def check_new_folder(path: Path, source: Path | None = None) -> Path:
    """The real path of a folder that `new_folder` can write; for commands that compute long before they write.

    Raises `InputError` as `new_folder` does, where nothing may be written, and for the folder `source` that is read.
    """
    real = check_folder(path)
    if real.exists() and source is not None and source.exists() and real.samefile(source):
        raise InputError(f"{real}: is the folder that is read. Choose another one for the output.")
    if real.is_mount():
        raise InputError(f"{real}: is a mount point, which cannot be replaced as a whole. Choose a folder inside it.")
    return real


def check_folder(path: Path, sources: Iterable[Path] = ()) -> Path:
    """The real path of a folder that is there, or can be made, to add files to.

    Raises `InputError` where there is a file, where nothing may be written, and for a folder that is, or lies in, one
    of `sources`, which are read.
    """
    try:
        real = path.resolve()  # so that the name and the parent of `.` and `out/..` are real ones
        there = real.exists()
    except (OSError, RuntimeError, ValueError) as error:  # a link that leads to itself, or a name that is too long
        raise InputError(f"{shortened(path, 200)}: cannot be written ({shortened(error, 100)}).") from error
    if there and not real.is_dir():
        raise InputError(f"{real}: is a file, a folder was expected. Choose another name for the output.")
    for source in sources:
        if real.is_relative_to(source.resolve()):
            raise InputError(f"{real}: lies in {source}, which is read. Choose another folder for the output.")
    missing, above = next((n, parent) for n, parent in enumerate(real.parents) if parent.exists())
    names = [real.name, *(parent.name for parent in real.parents[:missing])]
    if missing > _MOST_NEW or any(len(os.fsencode(name)) > _LONGEST_NAME for name in names):
        raise InputError(f"{shortened(real, 200)}: its name, or the path to it, is too long. Choose another one.")
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise InputError(
            f"{real}: cannot be written, {above} is no folder, read-only or not yours. Choose another place."
        )
    return real


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Raises `InputError` if another process is in such a block with the same folder; a killed one is in it no more.

    The folder itself is locked. Where a file system has no locks, or none for folders, nobody is refused.
    """
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise InputError(f"{folder}: another command is writing there. Wait, or choose another --out.") from None
    except OSError:  # no locks there
        pass
    try:
        yield
    finally:
        os.close(lock)


def _keep_others(old: Path, built: Path, without: Collection[str]) -> None:
    """Bring the entries of the folder `old` that `built` lacks, and that are not in `without`, into `built`."""
    for entry in old.iterdir():
        target = built / entry.name
        if entry.name in without or os.path.lexists(target):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, target, symlinks=True, copy_function=_link)
        else:
            _link(entry, target)
    shutil.copymode(old, built)


def _link(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # no links on this file system, or not for another user's file
        shutil.copy2(source, target, follow_symlinks=False)


def _put_in_place(built: Path, path: Path, old: Path) -> None:
    """Rename `built` to `path`; a folder that is there already ends as `built`, by way of `old` if need be."""
    inside = _working_folder(path)
    try:
        if not path.exists():
            built.rename(path)
        elif not exchange(built, path):
            path.rename(old)
            built.rename(path)
            old.rename(built)  # so that it is not taken for one to be brought back
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EBUSY):
            raise
        raise InputError(
            f"{path}: cannot be replaced as a whole ({error.strerror}). Choose a folder that is not there yet."
        ) from error
    if inside is not None and inside.is_dir():
        os.chdir(inside)  # or relative paths would mean the old folder


def _working_folder(path: Path) -> Path | None:
    """The working folder of this process if it lies in `path`."""
    try:
        here = Path.cwd()
    except FileNotFoundError:
        return None
    return here if here.is_relative_to(path) else None


def named_as_asked(message: str) -> str:
    """A message of the system with the names that were asked for in place of those in hidden folders beside them."""
    return re.sub(r"/\.([^/]+)\.[a-z0-9_]{8}\.part(/new/\1)?(?![^/\s:'\"])", r"/\1", message)


@contextmanager
def _workshop(path: Path) -> Iterator[Path]:
    """A hidden folder beside `path` with an empty folder `new` in it, locked while this block runs, then removed.

    What killed writers of `path` left is removed first. They are told from live ones by the lock, which the system
    takes from a process that ends.
    """
    clear_leftovers(path.parent, path.name)
    while True:
        workshop = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=_SUFFIX, dir=path.parent))
        try:
            lock = os.open(workshop / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        except FileNotFoundError:  # another writer took the empty folder for a leftover
            continue
        except OSError:  # a full disk, say
            workshop.rmdir()
            raise
        with suppress(OSError):  # a file system without locks: nobody can lock there, so nothing is ever cleared
            fcntl.flock(lock, fcntl.LOCK_EX)
        if (workshop / _LOCK).exists():
            break
        os.close(lock)
    try:
        (workshop / _NEW).mkdir()
        yield workshop
    except OSError as error:
        if error.filename is None and error.errno in NO_ROOM:  # the system does not say for which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        shutil.rmtree(workshop, ignore_errors=True)  # what cannot be removed now is a leftover
        os.close(lock)


def clear_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove the workshops of killed writers in `folder`, or those of `name` in it alone.

    A folder that one had renamed away is brought back first. Whoever writes a file or folder begins with this; what is
    kept because it is there already needs it too.
    """
    for left in folder.glob(f".{'*' if name is None else glob.escape(name)}.{_RANDOM_PART}{_SUFFIX}"):
        path = folder / left.name[1 : -len(f".{_RANDOM_PART}{_SUFFIX}")]
        try:
            lock = os.open(left / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:  # gone meanwhile, or another user's
            continue
        with suppress(OSError):  # somebody holds the lock: a live writer
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if (left / _OLD).is_dir() and not path.exists():
                (left / _OLD).rename(path)
            shutil.rmtree(left, ignore_errors=True)
        os.close(lock)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, whole or not at all."""
    with temporary_file(path) as part:
        part.write_text(text, encoding="utf-8")


def plain(value: Any) -> Any:
    """`value` ready for JSON or YAML: tensors and arrays as lists, paths as text, numbers rounded to 9 decimals.

    JSON knows no number that is not finite: such a one becomes None.
    """
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, float):
        return round(value, 9) + 0.0 if math.isfinite(value) else None  # + 0.0 turns −0 into 0
    return value


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` as indented JSON, each innermost list (a point, a row of a matrix) on one line.

    Tensors and arrays may stand anywhere in `content`; see `plain`.
    """
    text = json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False)
    text = re.sub(r"\[\s+([^\[\]{}\"]+?)\s+\]", lambda m: "[" + re.sub(r"\s+", " ", m[1]) + "]", text)
    write_text(path, text + "\n")


def read_json(path: Path, with_nan: bool = False) -> dict[str, Any]:
    """Content of a JSON file that holds an object. Raises `InputError` if it is missing or is something else.

    NaN and Infinity are refused unless `with_nan`, for files of programs that write them.
    """
    content = json_content(read_bytes(path, MOST_JSON_BYTES), str(path), with_nan)
    if not isinstance(content, dict):
        raise InputError(f"{path}: a JSON object {{…}} was expected, found {type(content).__name__}.")
    return content
