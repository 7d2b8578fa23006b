"""The path of an optimisation: poses at some of its improvements, for the trace and its replay."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.optimize import Result
from femoreg_torch.registration.scene import Poses

_MOST = 8  # moments of one optimisation: enough to see it converge, and the result stays a small file


@dataclass(frozen=True, eq=False)
class Moment:
    """The best poses after so many evaluations, and their cost."""

    evaluations: int
    value: float
    poses: Poses


def moments_of(result: Result, place: Callable[[Tensor], Poses]) -> tuple[Moment, ...]:
    """Moments evenly among the improvements of an optimisation, first and last included.

    `place` gives the poses of a delta (n,).
    """
    last = len(result.trace) - 1
    chosen = sorted({round(i * last / (_MOST - 1)) for i in range(_MOST)}) if result.trace else []
    return tuple(
        Moment(evaluations, value, place(torch.tensor(delta, dtype=torch.float64)))
        for evaluations, value, delta in (result.trace[i] for i in chosen)
    )


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
            "cost": moment.value,
            **({"camera_from_camera1": moment.poses.camera_from_camera1} if views_move else {}),
            "camera1_from": {name: moment.poses.camera1_from[name] for name in moving},
        }
        for moment in moments
    ]
