"""Digests of what a run depends on: the code that makes it, and the settings that it is made with."""

import hashlib
import json
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import femoreg_torch
import sim
from femoreg_torch.files import plain

_PRESETS = ("anatomy", "carm")  # what code reads of `configs` without being told to


@cache
def library() -> str:
    """Digest of the library's code and of the weights, at the first call: what this process has loaded."""
    root = Path(femoreg_torch.__file__).parent
    return _of_files(sorted(root.rglob("*.py")) + sorted((root.parent / "models").rglob("*.safetensors")))


@cache
def library_and_simulator() -> str:
    """The same of the simulator's code and of the presets that both read by themselves as well, short."""
    paths = sorted(Path(sim.__file__).parent.rglob("*.py"))
    with as_file(files("femoreg_torch.configs")) as root:
        paths += sorted(path for group in _PRESETS for path in (root / group).rglob("*.yaml"))
        return hashlib.sha256((library() + _of_files(paths)).encode()).hexdigest()[:16]


def digest(*values: Any) -> str:
    """Of what JSON can hold, tensors and paths included, short."""
    return hashlib.sha256(json.dumps(plain(values)).encode()).hexdigest()[:16]


def _of_files(paths: list[Path]) -> str:
    found = hashlib.sha256()
    for path in paths:
        found.update(path.read_bytes())
    return found.hexdigest()
