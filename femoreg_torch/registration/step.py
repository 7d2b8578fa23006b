"""What every step of a plan is, and what the words in it stand for."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from torch import Tensor

from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, DEVICE_IMAGES
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
    """The objects with a pose that a step names; [all] stands for all of them."""
    return list(poses.camera1_from) if list(names) == [ALL] else [name for name in names if name in poses.camera1_from]


def lacking(kinds: Sequence[Kind], views: Collection[int], scene: Scene) -> str | None:
    """Why there is nothing to see in images of some kinds and views (from 0), as the end of a sentence."""
    if scene.there(kinds, views):
        return None
    named = " or ".join(f"“{kind}”" for kind in kinds)
    where = "" if len(views) == scene.views else f" in view {', '.join(str(view + 1) for view in views)}"
    return f"there is no image of the kind {named}{where}"


def check_known(names: Iterable[str], kinds: Iterable[Kind], scene: Scene, poses: Poses) -> None:
    """Raise `InputError` that names the first object which the scene does not know.

    Where the scene has no image of one of a step's `kinds`, its names may be of objects that only those would show. A
    kind that no object of the scene is shown in, and no case of femur and device has, is a slip of the pen.
    """
    known = {ALL, ANATOMY_IMAGES, DEVICE_IMAGES, *scene.images}.union(
        *(thing.shown_in for thing in scene.objects.values())
    )
    for kind in kinds:
        if kind not in known:
            there = ", ".join(f"“{each}”" for each in scene.images)
            raise InputError(f"this case has no images of a kind “{kind}”; there are: {there}, and [{ALL}].")
    if any(kind not in scene.images for kind in kinds):
        return
    for name in sorted(set(names) - {ALL} - set(scene.objects)):
        raise InputError(
            f"the images of this case hold no object “{name}”; there are: {', '.join(poses.camera1_from)}."
        )


def one_after_another(records: Sequence[StageRecord], views: Sequence[int]) -> Iterator[StageRecord]:
    """Records of single `views` (from 0), made from the same poses, as if each had begun where the one before ended."""
    found: dict[int, Tensor] = {}

    def with_found(poses: Poses) -> Poses:
        for view, camera in found.items():
            poses = poses.with_view(view, camera)
        return poses

    for record, view in zip(records, views, strict=True):
        moments = tuple(replace(moment, poses=with_found(moment.poses)) for moment in record.moments)
        yield replace(record, poses=with_found(record.poses), moments=moments)
        found[view] = record.poses.camera_from_camera1[view]
