"""A stored plan carried out again, beside its place."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path as File
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from femoreg_torch.case import read_case
from femoreg_torch.case.model import Side
from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError
from femoreg_torch.planning.diffusion import NoMarrowError
from femoreg_torch.planning.offsets import Outcome, carried_out
from femoreg_torch.planning.path import Path, Surroundings
from femoreg_torch.planning.plan import until_yield
from femoreg_torch.planning.prepare import prepare
from femoreg_torch.planning.report import NOTICE, read_plan
from femoreg_torch.planning.response import Response, fit_response, gains

Array = NDArray[np.float64]

_MEND = "Give the case that it was planned from (--case), or plan again."
_SAME = 0.01  # loads of one femur on two machines differ by less, those of another CT hardly do


class Replan:
    """A stored plan, its femur, and its loads on this machine: without cement and as planned, with nothing moved.

    Raises `InputError` where the case is not the one that was planned for, by side, grid or loads.
    """

    def __init__(self, folder: File, case: File | None = None, device: torch.device = CPU) -> None:
        self.stored = read_plan(folder)
        content = read_case(case or self.stored.case)
        if content.side is not None and content.side != self.stored.side:
            raise InputError(
                f"{folder}: is a plan for the {self.stored.side} femur, the case {content.folder} is of the "
                f"{content.side} side. Give the case that it was planned from (--case)."
            )
        self.prepared = until_yield(prepare(content, self.stored.planning, device=device))
        femur = self.prepared.bone.femur
        self.side: Side = femur.side
        self.around = Surroundings(self.prepared.bone)
        box = tuple(slice(a, a + n) for a, n in zip(femur.corner, femur.mask.shape, strict=True))
        self._cement = self.stored.cement[box]
        if self._cement.shape != femur.mask.shape:
            raise InputError(f"{folder}: its cement lies on another grid than the CT of the case. Plan again.")
        self.baseline_n = self.prepared.curve().yield_load_n
        self._check(folder, content.folder, "without cement", self.stored.baseline_n, self.baseline_n)
        try:
            self.planned_n = self.at(np.zeros(3)).yield_load_n
        except NoMarrowError as error:
            raise InputError(f"{folder}: does not fit the case {content.folder}: {error} {_MEND}") from error
        if self.stored.planning.offsets.moves == "path":  # a pattern is stored in whole voxels, which is another load
            self._check(folder, content.folder, "as planned", self.stored.planned_n, self.planned_n)

    def _check(self, folder: File, case: File, state: str, stored_n: float, found_n: float) -> None:
        if abs(found_n - stored_n) > _SAME * stored_n:
            raise InputError(
                f"{folder}: holds a yield load of {stored_n:.0f} N {state}, the case {case} now gives {found_n:.0f} N, "
                f"so CT, label map or this program are not those of the plan. {_MEND}"
            )

    def at(self, move: Array) -> Outcome:
        """The plan moved by mm (3,), LPS, or by mm and degrees (6,) about its entry point."""
        return self._of(
            self.stored.path, np.concatenate([move, np.zeros(6 - len(move))]), self.stored.planning.offsets.moves
        )

    def along(self, path: Path) -> Outcome:
        """Another path carried out in its place."""
        return self._of(path, np.zeros(6), "path")

    def _of(self, path: Path, move: Array, moves: Literal["path", "pattern"]) -> Outcome:
        return carried_out(self.prepared, self.around, path, self._cement, move, moves)

    def response(self, outcomes: Mapping[str, Outcome], distance_mm: float) -> Response:
        """How the gain answers to small errors, from the six directions and four turned ends."""
        path = self.stored.path
        found = gains(outcomes, self.baseline_n)
        return fit_response(self.gain(self.planned_n), found, distance_mm, path.entry, path.target, self.side)

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
