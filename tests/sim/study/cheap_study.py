"""A study whose runs take a moment, drawn from their seeds: what the tests of the engine carry out."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femoreg_torch.files import plain
from sim.study.code import library_and_simulator
from sim.study.executors import OnThisMachine
from sim.study.procedures import Procedure
from sim.study.protocol import Protocol, Variation
from sim.study.store import Run
from sim.study.study import Study, run_study

library_and_simulator()  # once for all processes that are forked from one that has imported this


@dataclass(frozen=True)
class Cheap:
    """Makes records at random, but always the same ones."""

    seconds: float = 0.0
    broken: tuple[str, ...] = ()  # names of conditions whose every third run raises
    deadly: int = 0  # the number of a procedure that kills its process
    once: Path | None = None  # a file that is made when it does, so that it does so once

    def __call__(self, procedure: Procedure, scratch: Path) -> Callable[[Run], dict[str, Any]]:
        (scratch / "something.bin").write_bytes(bytes(1000))
        return self._made

    def _made(self, run: Run) -> dict[str, Any]:
        time.sleep(self.seconds)
        number = run.procedure.number
        if number == self.deadly and not (self.once and self.once.exists()):
            if self.once:
                self.once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if run.condition in self.broken and number % 3 == 0:
            raise ZeroDivisionError("a defect\nin two lines")
        rng = np.random.default_rng([run.procedure.seed, len(run.condition)])
        if number % 10 == 7:
            return {"refused": "too few landmarks", "trusted": False, "reasons": []}
        deviations = {
            f"{what}_deviation_{unit}": rng.random(3) for what, unit in (("translation", "mm"), ("rotation", "deg"))
        }
        return plain(
            {
                "refused": None,
                "trusted": bool(rng.random() < 0.9),
                "reasons": ["depth", "doubt"],
                "asked": ["pelvis"],
                "errors": {"pelvis": pose_error(rng), "tip_mm": rng.random()},
                "start_errors": {"pelvis": pose_error(rng)},
                "displacements_mm": {"tip": rng.random(3)},
                "miss": pose_error(rng),
                "quality": {"pelvis": {"trusted": True, **deviations}},
                "stages": [{"name": "pelvis in view 1", "view": None, "evaluations": 7, "seconds": time.time() % 1}],
                "timings_s": {"total": time.time() % 1},
            }
        )


def pose_error(rng: np.random.Generator) -> dict[str, Any]:
    """A row as `femoreg_torch.evaluation.errors` gives it."""
    return {"mm": rng.random(), "deg": rng.random(), "mm_xyz": rng.random(3), "deg_xyz": rng.random(3)}


def study(count: int, work: Cheap, conditions: tuple[str, ...] = ("plain",), settings: str = "s" * 16) -> Study:
    """So many procedures under some conditions."""
    protocol = Protocol([Variation(name) for name in conditions])
    runs = [
        Run("cheap", name, protocol.procedure(number, False), settings, "procedural", "fast", (("dose", 5),))
        for number in range(1, count + 1)
        for name in conditions
    ]
    return Study(runs, work)  # type: ignore[arg-type]  # no Work of procedures


def command(out: Path, jobs: int, count: int = 40) -> None:
    """A whole command, to be killed."""
    run_study(study(count, Cheap(seconds=0.03)), out, OnThisMachine(jobs))
