"""Broken files at every door: refused in one line, or taken, within ten seconds, and nothing printed beside.

The seed is new each time and is printed; FEMOREG_FUZZ_SEED repeats one, FEMOREG_FUZZ_COUNT says how many inputs there
are (`make fuzz`: ten thousand).
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import fuzz_run
import pytest
from fuzz_doors import doors

SEED = int(os.environ.get("FEMOREG_FUZZ_SEED", time.time_ns() % 2**31))
COUNT = int(os.environ.get("FEMOREG_FUZZ_COUNT", 400))


def test_valid_files_are_taken(tmp_path: Path) -> None:
    with fuzz_run.own_stderr() as printed:
        told = {door.name: fuzz_run.outcome(door, printed) for door in doors(tmp_path)}
    told = {name: found for name, found in told.items() if name not in ("image, npy", "mesh, bodies")}
    assert {name: found for name, found in told.items() if found != "taken"} == {}


def test_broken_files_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In a process of its own, which forks: threads of this one would not be there after a fork."""
    one_thread = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
    environment = os.environ | one_thread | {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    command = [sys.executable, fuzz_run.__file__, str(SEED), str(COUNT)]
    told = json.loads(subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout)
    with capsys.disabled():
        print(f"\nbroken files from seed {SEED}: {COUNT}; memory at most {told['most_mb']} MB")
        if "FEMOREG_FUZZ_COUNT" in os.environ:
            print("taken, refused, finds:")
            for door, counts in told["counts"].items():
                print(f"  {door}: {', '.join(map(str, counts.values()))}")
            for find in told["finds"]:
                print(f"  find: {find}")
    assert sum(sum(counts.values()) for counts in told["counts"].values()) == COUNT
    assert sorted({f"{find['door']}: {find['found']}" for find in told["finds"]}) == []
