"""Broken files at every door: refused in one line, or taken, within ten seconds, and nothing printed beside.

The seed is new each time and is printed; FEMOREG_FUZZ_SEED repeats one, FEMOREG_FUZZ_COUNT says how many inputs there
are (`make fuzz`: ten thousand).
"""

import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fuzz_doors import Door, doors
from fuzz_mutators import mutated_bytes, mutated_hdf5, mutated_text

from femoreg_torch.errors import InputError

SEED = int(os.environ.get("FEMOREG_FUZZ_SEED", time.time_ns() % 2**31))
COUNT = int(os.environ.get("FEMOREG_FUZZ_COUNT", 600))
LONGEST_S = 10.0
LONGEST_LINE = 2500  # what the command line would print; paths are long here


class TooLong(BaseException):
    """No reader may catch it."""


def _alarm(_number: int, _frame: object) -> None:
    raise TooLong


@contextmanager
def own_stderr() -> Iterator[int]:
    """The process' stderr turned into a file, by its descriptor."""
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield file.fileno()
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def broken(door: Door, valid: bytes, other: bytes, draw: random.Random) -> bytes:
    """One broken file."""
    if door.content is not None and draw.random() < 0.85:
        return mutated_text(door.content, door.as_json, other, draw)
    if door.path.suffix == ".h5" and draw.random() < 0.7:
        return mutated_hdf5(valid, draw)
    return mutated_bytes(valid, other, draw)


def outcome(door: Door, printed: int) -> str:
    """What became of a file: `taken`, `refused`, or what is wrong with the program."""
    before, began = os.fstat(printed).st_size, time.perf_counter()
    signal.setitimer(signal.ITIMER_REAL, 2 * LONGEST_S)
    try:
        door.read()
        found = "taken"
    except InputError as error:
        found = "refused" if len(str(error)) <= LONGEST_LINE else f"a message of {len(str(error))} characters"
    except OSError as error:
        found = "refused" if error.filename is not None else f"{error!r}"
    except TooLong:
        found = "hangs"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        found = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}, line {place.lineno})"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if time.perf_counter() - began > LONGEST_S:
        return f"{found} after {time.perf_counter() - began:.0f} s"
    if (size := os.fstat(printed).st_size) > before:
        return f"{found}, and prints {os.pread(printed, size - before, before)[:200]!r}"
    return found


def test_valid_files_are_taken(tmp_path: Path) -> None:
    with own_stderr() as printed:
        told = {door.name: outcome(door, printed) for door in doors(tmp_path)}
    told = {name: found for name, found in told.items() if name not in ("image, npy", "mesh, bodies")}
    assert {name: found for name, found in told.items() if found != "taken"} == {}


def test_broken_files_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    draw = random.Random(SEED)
    counts: Counter[tuple[str, str]] = Counter()
    finds: list[str] = []
    made = doors(tmp_path)
    valid = {door.name: door.path.read_bytes() for door in made}
    previous = signal.signal(signal.SIGALRM, _alarm)
    try:
        with own_stderr() as printed:
            for number in range(COUNT):
                door = made[number % len(made)]
                content = broken(door, valid[door.name], valid[draw.choice(made).name], draw)
                door.path.write_bytes(content)
                found = outcome(door, printed)
                door.path.write_bytes(valid[door.name])
                counts[door.name, found if found in ("taken", "refused") else "find"] += 1
                if found not in ("taken", "refused"):
                    finds.append(f"{door.name}: {found}")
                    if keep := os.environ.get("FEMOREG_FUZZ_KEEP"):
                        Path(keep, f"{SEED}_{number}{door.path.suffix}").write_bytes(content)
    finally:
        signal.signal(signal.SIGALRM, previous)
    with capsys.disabled():
        print(f"\nbroken files from seed {SEED}: {COUNT}, of them taken, refused:")
        if "FEMOREG_FUZZ_COUNT" in os.environ:
            for door in made:
                print(f"  {door.name}: {counts[door.name, 'taken']}, {counts[door.name, 'refused']}")
    assert sorted(set(finds)) == []
