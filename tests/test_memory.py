"""Freed memory that is kept: in a process of its own, as settings of the allocator cannot be taken back."""

import json
import os
import platform
import subprocess
import sys

import pytest

_PROGRAM = """
import json, os, resource
import numpy as np
from femoreg_torch.memory import keep_freed_memory
KEEP and keep_freed_memory()
def work():
    for _ in range(40):
        np.ones(4_000_000 + 500_000 * (_ % 3))  # 32 MB and more
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(json.dumps([faults, {k: v for k, v in os.environ.items() if k.startswith("MALLOC_")}]))
"""


def outcome(keep: bool, **more: str) -> tuple[int, dict[str, str]]:
    """Pages that the system had to clear, and what the environment says of the allocator."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")} | more
    program = _PROGRAM.replace("KEEP", str(keep))
    found = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, encoding="utf-8"
    )
    faults, told = json.loads(found.stdout)
    return faults, told


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator than glibc's")
def test_pages_of_freed_arrays_are_not_asked_for_again() -> None:
    given_back, _ = outcome(keep=False)
    kept, told = outcome(keep=True)
    assert kept < 0.1 * given_back
    assert told["MALLOC_ARENA_MAX"] == "1"  # for processes that this one starts


def test_what_the_environment_says_of_the_allocator_stands() -> None:
    _, told = outcome(keep=True, MALLOC_ARENA_MAX="4")
    assert told == {"MALLOC_ARENA_MAX": "4"}
