"""Many registrations in one process: equal results, and neither memory nor files nor threads that add up.

Run by `make soak`; FEMOREG_SOAK_COUNT says how many (200).
"""

import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from femoreg_torch.commands.main import main

COUNT = int(os.environ.get("FEMOREG_SOAK_COUNT", 200))
SETTLED = 0.2  # share of the runs after which caches are full
MOST_GROWTH_MB = 20.0


def memory_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def registered(arguments: list[str], out: Path) -> dict[str, Any]:
    """What a registration writes, but for how long it took."""
    assert main([*arguments, "--out", str(out)]) == 0
    content: dict[str, Any] = json.loads((out / "result.json").read_text())
    del content["timings_s"]
    for stage in content["stages"]:
        del stage["seconds"]
    return content


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore")
def test_registrations_in_one_process(small_registration: list[str], tmp_path: Path) -> None:
    first = registered(small_registration, tmp_path / "out")
    settled: tuple[float, int, int] | None = None
    for number in range(1, COUNT):
        assert registered(small_registration, tmp_path / "out") == first, f"run {number + 1} differs from the first"
        if number >= SETTLED * COUNT:
            now = memory_mb(), len(list(Path("/proc/self/fd").iterdir())), threading.active_count()
            settled = settled or now
            assert now[0] < settled[0] + MOST_GROWTH_MB, f"{now[0] - settled[0]:.0f} MB more after run {number + 1}"
            assert now[1:] == settled[1:], f"open files and threads after run {number + 1}"
    print(f"{COUNT} registrations: {settled and settled[0]:.0f} MB, then {memory_mb():.0f} MB")
