"""What a plan costs is measured as its own, whatever the study beside it holds."""

import subprocess
import sys

import numpy as np
import pytest

from sim.study.plans import cost_of


def test_memory_is_that_of_the_command_and_not_of_who_asks() -> None:
    held = np.ones(40_000_000)  # 0.3 GB of this process
    small = cost_of([sys.executable, "-c", "pass"])
    assert held.sum() == len(held)
    assert small["peak_gb"] < 0.1
    large = cost_of([sys.executable, "-c", "b = bytearray(b'1') * 300_000_000; sum(range(10**7))"])
    assert 0.28 < large["peak_gb"] < 0.5
    assert 0.05 < large["processor_s"] < large["wall_s"] + 0.1
    with pytest.raises(subprocess.CalledProcessError):
        cost_of([sys.executable, "-c", "raise SystemExit(3)"])
