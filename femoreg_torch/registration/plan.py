"""A workflow as data: the steps that a preset in `configs/registration/` lists."""

from dataclasses import dataclass, field
from typing import Any, Literal

from jsonargparse import ArgumentError, ArgumentParser

from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError
from femoreg_torch.optimize import Bobyqa, CmaEs, LevenbergMarquardt
from femoreg_torch.registration.objective import PLAIN, Imaging, Level, Prior
from femoreg_torch.registration.scene import Kind
from femoreg_torch.registration.weights import Weighting

VIEW, VIEWS = "view", "views"


@dataclass(frozen=True)
class BodyPlan:
    """A body to move: `move` names objects of the scene that move together, or the C-arm of a view.

    [view] is the view at hand in a stage for each other view, [views] stands for one body per view but the first.
    `rotation_deg` and `translation_mm` are per axis of the camera (x along columns, y along rows, z depth): the
    standard deviation of random candidates for CMA-ES and Levenberg–Marquardt, the half-width of the box for BOBYQA.
    Zero freezes an axis.
    """

    move: list[str]
    centre: str
    rotation_deg: list[float]
    translation_mm: list[float]


@dataclass(frozen=True)
class Stage:
    """One optimisation. `images` says which views take part: the first, each other view by itself, or all together.

    Objects are named as in the scene. `weights` says which pixels count, see `pixel_weights`; by default all do.
    `imaging` says what is drawn besides the objects; by default nothing.
    """

    name: str
    images: Literal["first", "each other", "all"]
    kinds: list[Kind]
    render: list[str]
    bodies: list[BodyPlan]
    level: Level
    optimiser: CmaEs | Bobyqa | LevenbergMarquardt
    prior: Prior | None = None
    weights: list[Weighting] = field(default_factory=list)
    imaging: Imaging = PLAIN

    @property
    def objects(self) -> set[str]:
        """The names of all objects that it draws, moves or turns about."""
        moved = {name for body in self.bodies for name in body.move} - {VIEW, VIEWS}
        return {*self.render, *moved, *(body.centre for body in self.bodies)}


@dataclass(frozen=True)
class OrbitSearch:
    """Exhaustive search of every other view along the C-arm's orbit, from the first view, in images of one kind."""

    name: str
    render: list[str]
    half_range_deg: float
    step_deg: float
    level: Level
    kind: Kind = "anatomy"

    @property
    def kinds(self) -> list[Kind]:
        """The kinds of images that it looks at."""
        return [self.kind]

    @property
    def objects(self) -> set[str]:
        """The names of all objects that it draws."""
        return set(self.render)


@dataclass(frozen=True)
class Plan:
    """All steps of a registration, in order. Steps that look at images which a case lacks are left out."""

    preset: str
    steps: tuple[Stage | OrbitSearch, ...]

    @property
    def needs_segmentations(self) -> bool:
        """Whether a stage weighs pixels by what the network sees in every view."""
        return any(isinstance(step, Stage) and "bones" in step.weights for step in self.steps)

    @property
    def imaging(self) -> Imaging:
        """What the last stage takes the images to be."""
        return next((step.imaging for step in reversed(self.steps) if isinstance(step, Stage)), PLAIN)


def load_plan(preset: str) -> Plan:
    """The workflow `configs/registration/<preset>.yaml`. Raises `InputError` that names preset, step and key."""
    return plan_from(preset, load_preset("registration", preset))


def plan_from(name: str, content: dict[str, Any]) -> Plan:
    """The workflow of this name whose `steps` stand in `content`. Raises `InputError` that names it, step and key."""
    return Plan(
        name,
        tuple(_step(step, f"registration preset {name}, step {i + 1}") for i, step in enumerate(content["steps"])),
    )


def _step(content: dict[str, Any], where: str) -> Stage | OrbitSearch:
    kind = OrbitSearch if "half_range_deg" in content else Stage
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(kind)
    try:
        step = kind(**vars(parser.instantiate(parser.parse_object(content))))
    except (ArgumentError, TypeError) as error:
        raise InputError(f"{where}: {' '.join(str(error).split())}") from error
    for body in getattr(step, "bodies", []):
        if len(body.rotation_deg) != 3 or len(body.translation_mm) != 3:
            raise InputError(f"{where}: rotation_deg and translation_mm need three numbers, one per camera axis.")
    return step
