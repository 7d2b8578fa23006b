"""A study as data: its procedures, and the conditions under which each of them is simulated and registered."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from femoreg_torch.configs import load_preset

from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.settings import read_record
from sim.study.closed_loop import ClosedLoop
from sim.study.conditions import Condition, check_faults
from sim.study.detections import DetectionNoise
from sim.study.procedures import Cohort, Procedure
from sim.study.starts import Offset

_NAME = re.compile(r"[A-Za-z0-9_]+")
_SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class Variation(Condition):
    """A condition with its registration. What is not said is as the protocol has it."""

    preset: str | None = None  # of the registration
    views: int | None = None  # only so many of the views of each case
    start: Offset | None = None  # of the pelvis, off the truth, in place of landmarks
    detections: DetectionNoise | None = None  # simulated landmarks, in place of those of the network
    varied: dict[str, Any] = field(default_factory=dict)  # numbers or text that tell what a list of settings changes


@dataclass(frozen=True)
class Protocol:
    """What a file of `configs/study/` like `paper.yaml` holds; its keys are explained there."""

    vary: list[Variation]
    procedures: int = 1000
    seed: int = 1
    first_patient: int = 10001
    subjects: list[str] = field(default_factory=list)
    cohort: Cohort | None = None
    simulation: str = "paper"
    preset: str = "fast"
    detections: DetectionNoise | None = None
    closed_loop: ClosedLoop | None = None
    cases: list[str] = field(default_factory=list)

    @property
    def bones(self) -> list[str]:
        """Names of the real bone shapes that some of its patients are built around."""
        return self.subjects if self.cohort is None else self.cohort.subjects

    def first(self, count: int, real: bool) -> list[Procedure]:
        """The first so many procedures, or all that there are; only where `real`, some are on real bone shapes."""
        if self.cohort is None:
            return [self.procedure(number, real) for number in range(1, count + 1)]
        return [procedure for procedure in self.cohort.procedures() if real or procedure.procedural][:count]

    def procedure(self, number: int, real: bool) -> Procedure:
        """The procedure of a number (from 1), whichever others are run.

        Its seed is a draw of the `number`-th child of numpy's SeedSequence(seed), so that procedures are independent.
        Patients and sides take turns; where `real`, every second patient is one of the subjects.
        """
        child = np.random.SeedSequence(self.seed, spawn_key=(number,))
        seed = int(child.generate_state(1)[0]) >> 1  # 31 bits, which every generator takes
        side = _SIDES[(number - 1) // 2 % 2]
        if real and number % 2 == 0:
            return Procedure(number, self.subjects[(number // 2 - 1) % len(self.subjects)], side, seed)
        return Procedure(number, str(self.first_patient + number - 1), side, seed)


def load_protocol(name: str | Path) -> Protocol:
    """A preset of `configs/study/`, or a YAML file. Raises `InputError` that names the key."""
    where = f"study {name}"
    content = load_preset("study", name)
    if "vary" not in content:
        raise InputError(f"{where}: has no `vary`, the list of conditions. `femoreg study paper` is one that has.")
    protocol = read_record(Protocol, content, where)
    for problem in _problems(protocol):
        raise InputError(f"{where}: {problem}")
    for variation in protocol.vary:
        check_faults(variation, f"{where}, {variation.name}")
    return protocol


def _problems(protocol: Protocol) -> Iterator[str]:
    names = [variation.name for variation in protocol.vary]
    if not names:
        yield "vary: at least one condition was expected."
    for name in names:
        if not _NAME.fullmatch(name):
            yield f"vary: {shortened(name)} is to be part of file names. Use letters, digits and _."
        if names.count(name) > 1:
            yield f"vary: {names.count(name)} conditions are called {shortened(name)}. Rename them."
    if protocol.cohort is not None and protocol.subjects:
        yield "subjects: stand in `cohort` where there is one."
    if protocol.procedures < 1:
        yield f"procedures: at least 1 was expected, got {protocol.procedures}."
    if min(protocol.seed, protocol.first_patient) < 0:
        yield "seed, first_patient: must not be negative."
    if protocol.closed_loop is not None and protocol.closed_loop.rounds < 1:
        yield "closed_loop, rounds: at least 1 was expected."
    if protocol.closed_loop is not None and protocol.cases:
        yield "closed_loop: recorded cases cannot be imaged again. Leave out one of `closed_loop` and `cases`."
    for variation in protocol.vary:
        changed = [key for key in ("acquisition", "xray", "carm") if getattr(variation, key)]
        if protocol.cases and (changed or variation.told != Variation(variation.name).told):
            told = ", ".join(changed) or "told"
            yield f"vary, {variation.name}: recorded cases cannot be simulated otherwise ({told})."
        for key, value in variation.varied.items():
            if not isinstance(value, str | int | float):
                yield f"vary, {variation.name}, varied, {key}: a number or text was expected."


def varied(variation: Variation) -> dict[str, Any]:
    """What a variation changes, by name: its single values that differ from the defaults, then what `varied` says."""
    found: dict[str, Any] = dict(_leaves(variation.acquisition)) | dict(_leaves(variation.xray))
    for part in (variation.told, variation.told.ct, variation.start, variation.detections):
        found |= {} if part is None else _changed(part)
    found |= {key: getattr(variation, key) for key in ("preset", "views", "carm") if getattr(variation, key)}
    return found | variation.varied


def _changed(record: Any) -> dict[str, Any]:
    """Single values of a settings record that are not its defaults."""
    values = ((entry, getattr(record, entry.name)) for entry in fields(record))
    return {e.name: value for e, value in values if value != e.default and isinstance(value, str | int | float)}


def _leaves(content: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _leaves(value)
        elif isinstance(value, str | int | float):
            yield key, value
