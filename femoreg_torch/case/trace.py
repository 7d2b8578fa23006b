"""What every step of a registration did, as a result holds it."""

from dataclasses import asdict, dataclass
from typing import Any

import torch

from femoreg_torch.geometry import Poses


@dataclass(frozen=True, eq=False)
class Moment:
    """The best poses of an optimisation after so many evaluations, and their cost."""

    evaluations: int
    cost: float
    poses: Poses


@dataclass(frozen=True)
class Restart:
    """Where one start of an optimisation ended, against the best end of all."""

    cost: float  # above the best
    apart_deg: float  # the greatest over all that the stage moves
    apart_mm: float  # of the reference point


@dataclass(frozen=True, eq=False)
class StageRecord:
    """One optimisation or exhaustive search of a step: how it ran, and the poses after it."""

    name: str  # of the step
    view: int | None  # from 1: the view that a step for each other view was run on
    cost: float
    evaluations: int
    seconds: float
    stop: str  # why it stopped, in words
    poses: Poses
    restarts: tuple[Restart, ...] = ()  # its other starts, the best first
    moments: tuple[Moment, ...] = ()  # along the way, first and last improvement included
    moving: tuple[str, ...] = ()  # the objects that it moved, all of them with a C-arm


def changes_content(poses: Poses) -> dict[str, Any]:
    """How the cameras differ from the C-arm's file, as the result holds it; nothing where they were not refined."""
    return {"carm_refined": [asdict(change) for change in poses.changes]} if poses.changes else {}


def moments_content(moments: tuple[Moment, ...]) -> list[dict[str, Any]]:
    """Moments as the result holds them: of the poses, those alone that change along the way."""
    if not moments:
        return []
    end = moments[-1].poses
    moving = [
        name
        for name, pose in end.camera1_from.items()
        if any(not torch.equal(moment.poses.camera1_from[name], pose) for moment in moments)
    ]
    views_move = any(not torch.equal(m.poses.camera_from_camera1, end.camera_from_camera1) for m in moments)
    return [
        {
            "evaluations": moment.evaluations,
            "cost": moment.cost,
            **changes_content(moment.poses),
            **({"camera_from_camera1": moment.poses.camera_from_camera1} if views_move else {}),
            "camera1_from": {name: moment.poses.camera1_from[name] for name in moving},
        }
        for moment in moments
    ]
