"""A registration killed at any moment leaves the old run or the new one, and the next start cleans up."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROUNDS = 8
SEED = random.SystemRandom().randrange(2**31)


def started(arguments: list[str]) -> "subprocess.Popen[bytes]":
    code = "import sys; from femoreg_torch.commands.main import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_registration_that_is_killed(small_registration: list[str], how: signal.Signals, tmp_path: Path) -> None:
    draw, runs = random.Random(SEED), tmp_path / "runs"
    runs.mkdir()
    arguments = [*small_registration, "--out", str(runs / "run")]
    began = time.perf_counter()
    assert started(arguments).wait() == 0
    longest = time.perf_counter() - began
    (runs / "run" / "notes.txt").write_text("mine", encoding="utf-8")
    seeds = [0]
    for n in range(1, ROUNDS):
        process = started([*arguments, "--seed", str(n)])
        time.sleep(longest * (draw.random() if n % 2 else draw.uniform(0.9, 1.05)))  # half of them while it writes
        process.send_signal(how)
        process.wait()
        result = json.loads((runs / "run" / "result.json").read_text(encoding="utf-8"))
        assert result["seed"] in (seeds[-1], n), f"seed {SEED}"
        assert {path.name for path in (runs / "run").iterdir()} == {
            "result.json", "navigation.json", "navigation", "notes.txt"
        }, f"seed {SEED}"  # fmt: skip
        seeds.append(result["seed"])
    assert started(arguments).wait() == 0
    assert [path.name for path in runs.iterdir()] == ["run"]
    assert (runs / "run" / "notes.txt").read_text(encoding="utf-8") == "mine"
