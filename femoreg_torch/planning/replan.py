"""A stored plan carried out again, beside its place."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path as File
from typing import Any

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.case import read_case
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.planning.offsets import Outcome, carried_out
from femoreg_torch.planning.path import Surroundings
from femoreg_torch.planning.plan import until_yield
from femoreg_torch.planning.prepare import prepare
from femoreg_torch.planning.report import NOTICE, read_plan

Array = NDArray[np.float64]


class Replan:
    """A stored plan, its femur, and its loads on this machine: without cement and as planned, with nothing moved."""

    def __init__(self, folder: File, case: File | None = None) -> None:
        self.stored = read_plan(folder)
        self._prepared = until_yield(prepare(read_case(case or self.stored.case), self.stored.planning))
        femur = self._prepared.bone.femur
        self.side: Side = femur.side
        self._around = Surroundings(self._prepared.bone)
        box = tuple(slice(a, a + n) for a, n in zip(femur.corner, femur.mask.shape, strict=True))
        self._cement = self.stored.cement[box]
        if self._cement.shape != femur.mask.shape:
            raise InputError(f"{folder}: its cement lies on another grid than the CT of the case. Plan again.")
        self.baseline_n = self._prepared.curve().yield_load_n
        self.planned_n = self.at(np.zeros(3)).yield_load_n

    def at(self, offset: Array) -> Outcome:
        """The plan moved by an offset (3,), LPS mm."""
        moves = self.stored.planning.offsets.moves
        return carried_out(self._prepared, self._around, self.stored.path, self._cement, offset, moves)

    def gain(self, load_n: float) -> float:
        """Gain over the femur without cement, %."""
        return 100 * (load_n / self.baseline_n - 1)

    def content(self, outcomes: Mapping[str, Sequence[Outcome]]) -> dict[str, Any]:
        """What a file tells of them."""
        return {
            "version": 1,
            "notice": NOTICE,
            "moves": self.stored.planning.offsets.moves,
            "baseline_n": self.baseline_n,
            "planned_n": self.planned_n,
            "planned_gain_percent": self.gain(self.planned_n),
            "outcomes": {
                name: [dataclasses.asdict(o) | {"gain_percent": self.gain(o.yield_load_n)} for o in many]
                for name, many in outcomes.items()
            },
        }
