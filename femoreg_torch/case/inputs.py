"""What a registration of a case reads, as one digest: whether a result still belongs to the files as they are now."""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import Any, cast

from femoreg_torch.arrays import opened
from femoreg_torch.case.model import Case
from femoreg_torch.files import plain
from femoreg_torch.text import read_yaml
from femoreg_torch.volume.text_headers import file_of_values

_YAML = (".yaml", ".yml")


def inputs_digest(case: Case, others: Mapping[str, Path | None] | None = None, settings: Any = None) -> str:
    """Digest of the contents of a case's files, wherever they lie, of `others` by what they are for, and of `settings`.

    The files are `case.yaml`, all that it names, those of folders with a CT or labels, and what YAML files among them
    name in turn. Names count as they are told there, times of change do not: a case may be copied or moved with its
    files. It takes a second for each gigabyte. Raises `InputError` for a file that cannot be read.
    """
    found = hashlib.sha256(json.dumps(plain(settings)).encode())
    for name, path in _files(case, _named(case.folder / "case.yaml", "case.yaml", set()), others or {}):
        found.update(f"{name}\0{_content(path)}\0".encode())
    return found.hexdigest()[:32]


def case_digest(case: Case) -> str:
    """Digest as of `inputs_digest`, of what a case is registered from alone: without its truth, which may come later.

    Comments and the order of keys in `case.yaml` do not count. Raises `InputError` for a file that cannot be read.
    """
    file = case.folder / "case.yaml"
    content = {key: value for key, value in read_yaml(file).items() if key != "truth"}
    found = hashlib.sha256(json.dumps(plain(content), sort_keys=True).encode())
    texts = [text for text in dict.fromkeys(_texts(content)) if _is_file(case.folder / text)]
    named = chain.from_iterable(_named(case.folder / text, text, {file}) for text in texts)
    for name, path in _files(case, named, {}):
        found.update(f"{name}\0{_content(path)}\0".encode())
    return found.hexdigest()[:32]


def _files(
    case: Case, named: Iterable[tuple[str, Path]], others: Mapping[str, Path | None]
) -> Iterator[tuple[str, Path]]:
    """Every file with the name that it has wherever the case lies, in an order that does not change.

    Those that are `named` in `case.yaml`, those of folders, and `others` by what they are for.
    """
    for name, path in named:
        yield name, path
        if (values := file_of_values(path)) != path:
            yield f"values of {name}", values
    for kind, place in (("ct", case.ct_path), ("labels", case.labels_path)):
        if place is not None and place.is_dir():
            for path in _inside(place):
                yield f"{kind} {path.relative_to(place).as_posix()}", path
    for name, other in others.items():
        if other is not None:
            yield f"--{name}", other


def _named(file: Path, name: str, before: set[Path]) -> Iterator[tuple[str, Path]]:
    """A file, and if it is a YAML file all that are named in it, and in those."""
    yield name, file
    if file.suffix not in _YAML or file in before:
        return
    before.add(file)
    for text in dict.fromkeys(_texts(read_yaml(file))):
        path = file.parent / text
        if _is_file(path):
            yield from _named(path, text, before)


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a text that is no path: too long, or with a null byte
        return False


def _inside(folder: Path) -> list[Path]:
    """All files in a folder, also in folders that are linked there, in order."""
    found: list[Path] = []
    seen: set[str] = set()
    for root, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(root)
        if real in seen:  # a link that leads back
            folders.clear()
            continue
        seen.add(real)
        found += [path for name in names if _is_file(path := Path(root) / name)]
    return sorted(found)


def _content(path: Path) -> str:
    with opened(path) as file:
        return hashlib.file_digest(cast(BufferedReader, file), "sha256").hexdigest()
