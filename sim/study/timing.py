"""How long a whole procedure takes: `femoreg register` from six images to the written result, one after the other."""

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.case import RESULT_NAME
from femoreg_torch.files import read_json

_BAD_INPUT = 2  # exit status of `femoreg`


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds of the runs that gave poses: of the command, and of its parts as the result tells them."""

    command: list[float]
    parts: list[dict[str, float]]
    refused: int  # runs whose input was refused

    def told(self) -> str:
        """A sentence with medians."""
        if not self.command:
            return f"`femoreg register` refused all {self.refused} procedures that were to be timed."
        refused = f" ({self.refused} more were refused)" if self.refused else ""
        parts = ", ".join(f"{key} {statistics.median(run[key] for run in self.parts):.1f} s" for key in self.parts[0])
        return (
            f"**Whole procedure**, `femoreg register` as a command (start of Python, six images, network detection, "
            f"registration, written result), {len(self.command)} procedures{refused} one after the other: median "
            f"**{statistics.median(self.command):.1f} s**, longest {max(self.command):.1f} s. Medians within: {parts}."
        )


def time_register(cases: Sequence[Path], preset: str) -> Timing:
    """Run the command on every case, after one run that is not counted and compiles what is kept compiled.

    The start comes from the network, not from simulated detections.
    """
    _run(cases[0], preset)
    runs = [run for case in cases if (run := _run(case, preset))]
    return Timing([seconds for seconds, _ in runs], [parts for _, parts in runs], len(cases) - len(runs))


def _run(case: Path, preset: str) -> tuple[float, dict[str, float]] | None:
    """Seconds of the command and of its parts; None if it refused its input, `ChildProcessError` if it broke."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "femoreg_torch.commands.main", "register"]
        began = time.perf_counter()
        done = subprocess.run(
            [*command, str(case), "--out", str(out), "--preset", preset], capture_output=True, encoding="utf-8"
        )
        seconds = time.perf_counter() - began
        if done.returncode == _BAD_INPUT:
            return None
        if done.returncode:
            raise ChildProcessError(f"{case}: `femoreg register` failed:\n{done.stderr}")
        return seconds, read_json(out / RESULT_NAME)["timings_s"]
