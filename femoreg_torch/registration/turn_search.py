"""Exhaustive search of a tool's turn about its guide, which a nominal pose may have wrong by any angle."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.geometry import Poses, rotation_angle, transform_points
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, Kind, Scene, moved, reference_point_in_view
from femoreg_torch.registration.step import Step, check_known, chosen_kinds, chosen_objects, lacking
from femoreg_torch.settings import check_within
from femoreg_torch.similarity import Similarity

# Of the mean cost: what a far turn must fit better by. Of 30 right devices none fitted better, turned by 15° or more.
# Of six whose nominal turn, or a part, was far off another turn fitted better by 0.03 to 0.06 where a registration had
# ended, of a seventh by 0.01, not refined there.
_LEAST_GAIN = 0.01
_NEAR_DEG = 15.0
# A stage alone may end at a near turn that fits less well: an awl whose marker frame one view shows ended 6 to 13° off,
# and the right turn fitted better by 0.0047 to 0.0084. A drill whose turn hardly showed gained 0.0006 by a wrong one.
_LEAST_NEAR_GAIN = 0.002
_OPTIMISER = LevenbergMarquardt(max_iterations=12, tol_x=0.01, tol_f=3e-6)
_SCALE = (0.05, 0.05, 0.05, 4.0, 4.0, 6.0)  # rad and mm: one unit of a motion


@dataclass(frozen=True)
class TurnSearch:
    """Looks whether tools fit better turned about their guide by any angle, and refines the pose there.

    Of the named `objects`, those whose guide is known and which are not round. Costs are the mean over all images of
    the given kinds. [all] in `kinds`, `render` or `objects` stands for all.
    """

    name: str
    kinds: list[Kind]
    render: list[str]
    objects: list[str]
    step_deg: float
    level: Level
    similarity: Similarity

    def __post_init__(self) -> None:
        check_within(self, step_deg=(0.1, 180))

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`."""
        kinds = chosen_kinds(self.kinds, scene)
        check_known({*self.render, *self.objects}, kinds, scene, poses)
        if reason := lacking(kinds, range(scene.views), scene):
            return reason
        if not self._turning(scene, poses):
            return "its images show nothing that may turn about a guide: no tip and base are named, or it is round"
        return None

    def run(self, scene: Scene, poses: Poses, seed: int) -> Iterator[StageRecord]:
        """One search for every tool, see `Step`; nothing is random."""
        for name in self._turning(scene, poses):
            record = self._search(scene, poses, name)
            yield record
            poses = record.poses

    def _turning(self, scene: Scene, poses: Poses) -> list[str]:
        kinds = [kind for kind, _ in scene.there(chosen_kinds(self.kinds, scene), range(scene.views))]
        return [
            name
            for name in chosen_objects(self.objects, poses)
            if scene.objects[name].guide is not None
            and scene.objects[name].axis is None
            and any(scene.shown([name], kind) for kind in kinds)
        ]

    def _angles(self) -> Tensor:
        """0, then all turns that are looked at (A,), degrees; near ones in steps of half the size."""
        near = torch.arange(0, _NEAR_DEG, self.step_deg / 2, dtype=torch.float64)[1:]
        far = torch.arange(-180, 180, self.step_deg, dtype=torch.float64)
        return torch.cat([near.new_zeros(1), -near, near, far[far.abs() >= _NEAR_DEG]])

    def _search(self, scene: Scene, start: Poses, name: str) -> StageRecord:
        began, poses = time.perf_counter(), start
        kinds = chosen_kinds(self.kinds, scene)
        images = [image for image in scene.there(kinds, range(scene.views)) if scene.shown([name], image[0])]
        render = chosen_objects(self.render, start)

        def costs(there: Poses, body: Body) -> ImageCosts:
            return image_costs(scene, there, (body,), render, images, self.level, self.similarity)

        about_guide, axis = _guide(scene, start, name)
        angles = self._angles()
        deltas = torch.deg2rad(angles)[:, None] * axis
        found = costs(start, about_guide)(deltas).mean(1)

        def refined(at: Poses) -> tuple[float, Poses, int]:
            """Cost and poses where the tool fits best near a place, and evaluations."""
            body = Body(
                (name,), 0, reference_point_in_view(scene, at, name, 0), at.camera_from_camera1.new_tensor(_SCALE)
            )
            fit = _OPTIMISER.minimise(stage_objective(costs(at, body), (body,), None), len(body.free), seed=0)
            return fit.value, moved(at, (body,), fit.delta), fit.evaluations

        here, settled, told = float(found[0]), False, f"no other turn of the {name} fits better"
        evaluations = len(angles)
        for near, gain in ((False, _LEAST_GAIN), (True, _LEAST_NEAR_GAIN)):
            asked = ((angles.abs() < _NEAR_DEG) == near) & (angles != 0)
            if not asked.any():  # of steps so wide
                continue
            best = int(torch.where(asked, found, math.inf).argmin())
            cost, there, more = refined(moved(start, (about_guide,), deltas[best]))
            evaluations += more
            if cost < here - gain and not settled:  # where it lies may not be settled, so it is refined likewise
                here, poses, more = refined(start)
                evaluations, settled = evaluations + more, True
            if cost < here - gain:
                here, poses = cost, there
                told = f"the {name} fits better turned by {float(angles[best]):.0f}° about its guide"
                break
        seconds = time.perf_counter() - began
        return StageRecord(self.name, None, here, evaluations, seconds, told, poses, moving=(name,))


def _guide(scene: Scene, poses: Poses, name: str) -> tuple[Body, Tensor]:
    """A tool as a body that turns about the base of its guide, and the guide's direction (3,) in camera 1."""
    guide = scene.objects[name].guide
    assert guide is not None  # asked before
    base, tip = transform_points(poses.camera1_from[name], torch.stack(guide))
    turning = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    return Body((name,), 0, base, turning), (tip - base) / (tip - base).norm()


def turned_from_where_told(
    steps: Sequence[Step], trace: Sequence[StageRecord], found_deg: Mapping[str, float | None]
) -> tuple[str, ...]:
    """Tools that a search found turned about their guide, in words: the nominal pose is wrong, or the model mirrored.

    A handle that is its own mirror image fits as well turned round as mirrored, so that no image tells which it is.
    `found_deg` has by how much each object is turned at the end against its nominal pose; None: that is not known. A
    search may only have turned back what a stage before it had turned.
    """
    searches = {step.name for step in steps if isinstance(step, TurnSearch)}
    told = []
    for before, record in pairwise(trace):
        for name in record.moving if record.name in searches else ():
            first, then = (each.poses.camera1_from[name][:3, :3] for each in (before, record))
            deg = float(rotation_angle(first.T @ then)) * 180 / math.pi
            at_end = found_deg.get(name)
            if deg > _NEAR_DEG and (at_end is None or at_end > _NEAR_DEG):
                told.append(
                    f"the {name} was found turned by {deg:.0f}° about its guide against its nominal pose: if that pose "
                    "is right, the model is mirrored, or not the one in the images; if it fits there in the overlay, "
                    "tell the pose found as the nominal one and register again"
                )
    return tuple(told)
