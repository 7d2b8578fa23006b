"""Writing files so that a run which fails leaves nothing half-written behind."""

import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from femoreg_torch.errors import InputError


@contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """A path beside `path` with the same suffixes, to be written by the caller and renamed to `path` at success.

    Raises `InputError` if the folder of `path` does not exist.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot be written, there is no folder {path.parent}. Make it first.")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        part = Path(folder) / path.name
        yield part
        part.replace(path)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its place when the block ends without an exception.

    If `path` exists already, what was built replaces the entries of the same names and leaves all others alone; if the
    block fails, nothing of `path` has changed. Raises `InputError` if `path` is a file.
    """
    path = path.resolve()  # so that the name and the parent of `.` and `out/..` are real ones
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, a folder was expected. Choose another name for the output.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        built = Path(folder) / path.name
        built.mkdir()
        yield built
        if not path.exists():
            built.replace(path)
            return
        for entry in sorted(built.iterdir()):
            target = path / entry.name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            entry.replace(target)


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


def read_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file that holds an object. Raises `InputError` if it is missing or is something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error}).") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: a JSON object {{…}} was expected, found {type(content).__name__}.")
    return content
