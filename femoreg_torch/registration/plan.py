"""A workflow as data: the steps that a preset in `configs/registration/` lists."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.extensions import check_has, find, pop_kind, record_of
from femoreg_torch.optimize import Optimiser, read_optimiser
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.materials.calibration import Calibration
from femoreg_torch.registration.orbit import OrbitSearch
from femoreg_torch.registration.stage import Stage
from femoreg_torch.registration.step import Step
from femoreg_torch.registration.turn_search import TurnSearch
from femoreg_torch.settings import read_record
from femoreg_torch.similarity import Similarity, read_similarity

STEPS = {"stage": Stage, "orbit_search": OrbitSearch, "calibration": Calibration, "turn_search": TurnSearch}
_READERS = {Similarity: read_similarity, Optimiser: read_optimiser}  # of fields that say their `kind`


@dataclass(frozen=True)
class Plan:
    """All steps of a registration, in order. Steps that a case has nothing to do for are left out."""

    preset: str
    steps: tuple[Step, ...]

    @property
    def stages(self) -> list[Stage]:
        """The steps that are optimisations."""
        return [step for step in self.steps if isinstance(step, Stage)]

    @property
    def needs_segmentations(self) -> bool:
        """Whether a stage weighs pixels by what the network sees in every view."""
        return any("bones" in stage.weights for stage in self.stages)

    @property
    def imaging(self) -> Imaging:
        """What the last stage takes the images to be."""
        return self.stages[-1].imaging if self.stages else PLAIN


def load_plan(preset: str | Path) -> Plan:
    """The workflow `configs/registration/<preset>.yaml`, or that of a YAML file.

    Raises `InputError` that names preset, step and key.
    """
    return plan_from(str(preset), load_preset("registration", preset))


def plan_from(name: str, content: dict[str, Any]) -> Plan:
    """The workflow of this name whose `steps` stand in `content`. Raises `InputError` that names it, step and key."""
    where = f"registration preset {name}"
    steps = read_record(_Content, content, where).steps
    if not steps:
        raise InputError(f"{where}, steps: none is left, so nothing would be registered. Name at least one.")
    return Plan(name, tuple(_step(step, f"{where}, {_called(i, step)}") for i, step in enumerate(steps)))


@dataclass(frozen=True)
class _Content:
    """What a preset holds."""

    steps: list[dict[str, Any]]


def _called(index: int, content: dict[str, Any]) -> str:
    """The number of a step, from 1, and its name, if it has one."""
    name = content.get("name")
    return f"step {index + 1}{f' ({shortened(name)})' if isinstance(name, str) else ''}"


def _step(content: dict[str, Any], where: str) -> Step:
    kind, rest = pop_kind(content, where)
    record = record_of(find("femoreg_torch.steps", kind, STEPS, where), where)
    readers = {name: _READERS[hint] for name, hint in get_type_hints(record).items() if hint in _READERS}
    ready = {name: read(rest.pop(name), f"{where}, {name}") for name, read in readers.items() if name in rest}
    step: Step = read_record(record, rest, where, ready)
    check_has(step, "femoreg_torch.steps", ["left_out", "run"], where)
    return step
