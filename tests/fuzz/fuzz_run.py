"""Broken files given to what reads them, in processes that may crash or hang: `fuzz_run.py SEED COUNT [FIRST]`.

This process imports and reads everything once, then forks, so that a crash costs a millisecond in place of seconds. Its
child says which file it takes and what became of it; where it dies, or says nothing for too long, another goes on with
the next file. Each file depends on the seed and its number alone.

Prints one JSON object: `counts` by door, of `taken`, `refused` and `find`; `finds`, each with its number and door; the
most memory that a child had, MB. Files that were a find are kept in the folder FEMOREG_FUZZ_KEEP, if it is set.
"""

import json
import os
import random
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fuzz_doors import Door, doors
from fuzz_mutators import mutated_bytes, mutated_hdf5, mutated_text

from femoreg_torch.errors import InputError

LONGEST_S = 10.0
_SILENT_S = 3 * LONGEST_S  # after which a child that Python cannot stop is killed
_BATCH = 1000  # files for a child; what leaks then stays small
_LONGEST_LINE = 2500  # characters; the command line cuts at 2000, and paths are long here


class TooLong(BaseException):
    """No reader may catch it."""


def _alarm(_number: int, _frame: object) -> None:
    raise TooLong


@contextmanager
def own_stderr() -> Iterator[int]:
    """The process' stderr turned into a file, by its descriptor; what takes too long is stopped."""
    sys.stderr.flush()
    kept, previous = os.dup(2), signal.signal(signal.SIGALRM, _alarm)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield file.fileno()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            signal.signal(signal.SIGALRM, previous)


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
        found = "refused" if len(str(error)) <= _LONGEST_LINE else f"a message of {len(str(error))} characters"
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


def _content(made: Sequence[Door], valid: Mapping[str, bytes], seed: int, number: int) -> bytes:
    draw = random.Random(f"{seed} {number}")
    door = made[number % len(made)]
    return broken(door, valid[door.name], valid[draw.choice(made).name], draw)


def _read_all(made: Sequence[Door], valid: Mapping[str, bytes], seed: int, numbers: range, told: int) -> None:
    """In a child: a line with what became of each file."""
    with own_stderr() as printed:
        for number in numbers:
            door = made[number % len(made)]
            door.path.write_bytes(_content(made, valid, seed, number))
            found = outcome(door, printed)
            door.path.write_bytes(valid[door.name])
            os.write(told, json.dumps(found).encode() + b"\n")


def _child(made: Sequence[Door], valid: Mapping[str, bytes], seed: int, numbers: range) -> Iterator[str]:
    """What became of these files, as far as one child comes; if it does not come to the end, how it ended."""
    ours, theirs = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(ours)
        try:
            _read_all(made, valid, seed, numbers, theirs)
        except BaseException:  # of this harness
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    os.close(theirs)
    rest = b""
    while select.select([ours], [], [], _SILENT_S)[0]:
        if not (some := os.read(ours, 2**16)):
            break
        *lines, rest = (rest + some).split(b"\n")
        yield from map(json.loads, lines)
    else:
        os.kill(process, signal.SIGKILL)
    os.close(ours)
    if code := os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]):
        yield f"ends the process, with {code}" if code != -signal.SIGKILL else f"says nothing for {_SILENT_S:.0f} s"


def run(folder: Path, seed: int, count: int, first: int = 0) -> dict[str, Any]:
    """Read so many broken files, below `folder`, from the number `first` on; what is printed, see above."""
    made = doors(folder)
    valid = {door.name: door.path.read_bytes() for door in made}
    with own_stderr() as printed:
        for door in made:
            outcome(door, printed)  # all is imported now
    counts: Counter[tuple[str, str]] = Counter()
    finds = []
    number, end = first, first + count
    while number < end:
        for found in _child(made, valid, seed, range(number, min(number + _BATCH, end))):
            door = made[number % len(made)]
            counts[door.name, found if found in ("taken", "refused") else "find"] += 1
            if found not in ("taken", "refused"):
                finds.append({"number": number, "door": door.name, "found": found})
                if keep := os.environ.get("FEMOREG_FUZZ_KEEP"):
                    name = f"{seed}_{number}{''.join(door.path.suffixes)}"
                    Path(keep, name).write_bytes(_content(made, valid, seed, number))
                door.path.write_bytes(valid[door.name])  # as a child that died did not
            number += 1
    kinds = ("taken", "refused", "find")
    return {
        "counts": {door.name: {kind: counts[door.name, kind] for kind in kinds} for door in made},
        "finds": finds,
        "most_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024,
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(run(Path(place), *map(int, sys.argv[1:]))))
