"""Do the starts of an optimisation agree? Another end that fits as well makes the best one doubtful."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from femoreg_torch.case.trace import Restart
from femoreg_torch.geometry import Poses, pose_difference
from femoreg_torch.optimize import Result
from femoreg_torch.registration.scene import Body, Moving, Scene


def restarts_of(
    result: Result, scene: Scene, bodies: Sequence[Moving], poses_after: Callable[[Tensor], Poses]
) -> tuple[Restart, ...]:
    """The ends of all starts but the best, the best of them first; none of an optimiser that has one start."""
    ends = sorted(result.ends)
    places = [poses_after(torch.tensor(delta, dtype=torch.float64)) for _, delta in ends]
    found = []
    for (cost, _), place in zip(ends[1:], places[1:], strict=True):
        rigid = [body for body in bodies if isinstance(body, Body)]
        apart = [_apart(scene, body, places[0], place) for body in rigid] or [(0.0, 0.0)]
        found.append(Restart(cost - ends[0][0], max(deg for deg, _ in apart), max(mm for _, mm in apart)))
    return tuple(found)


def _apart(scene: Scene, body: Body, first: Poses, second: Poses) -> tuple[float, float]:
    """Degrees and mm between two poses of what a body moves, in the camera that it moves in.

    Of a round object its turn about its own axis does not count.
    """
    name = next(iter(body.objects or first.camera1_from))
    moved = scene.objects[name]
    before, after = (poses.camera_from(name)[body.view] for poses in (first, second))
    if moved.axis is not None and body.objects:
        return moved.axis.difference(before, after)
    return pose_difference(before, after, moved.reference_point)
