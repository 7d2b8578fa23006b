"""What every step of a plan is, and what the words in it stand for."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.scene import Kind, Scene

ALL = "all"  # objects that have a pose, or kinds of images that the case has
ONE_VIEW = "this case has one view only"
CARM_IS_KNOWN = "the C-arm's poses are given"


class Step(Protocol):
    """A step of a plan, by convention a frozen dataclass, which presets read by its `kind`."""

    @property
    def name(self) -> str:
        """What people call it."""

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do in a scene, as the end of a sentence; None: it runs. `poses` are those at the start.

        Raises `InputError` where it cannot run and the steps after it need what it finds, and for an object that has no
        pose.
        """

    def run(self, scene: Scene, poses: Poses, seed: int) -> Iterator[StageRecord]:
        """What it does from the poses before it, one record after another; the last one holds the poses after it."""


def chosen_kinds(kinds: Sequence[Kind], scene: Scene) -> list[Kind]:
    """The kinds of images that a step names; [all] stands for all of the scene."""
    return list(scene.images) if list(kinds) == [ALL] else list(kinds)


def chosen_objects(names: Sequence[str], poses: Poses) -> list[str]:
    """The objects that a step names; [all] stands for all that have a pose."""
    return list(poses.camera1_from) if list(names) == [ALL] else list(names)


def lacking(kinds: Iterable[Kind], scene: Scene) -> str | None:
    """What kind of images a scene lacks, as the end of a sentence."""
    missing = next((kind for kind in kinds if kind not in scene.images), None)
    return None if missing is None else f"not every view of this case has an image of the kind “{missing}”"


def check_placed(names: Iterable[str], poses: Poses) -> None:
    """Raise `InputError` that names the first object without a pose."""
    for name in sorted(set(names) - set(poses.camera1_from)):
        raise InputError(
            f"the images of this case hold no object “{name}”; there are: {', '.join(poses.camera1_from)}."
        )
