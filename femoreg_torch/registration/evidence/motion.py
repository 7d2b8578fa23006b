"""Has the anatomy moved between the images without and with the device, or a bone or the device between the views?

All images are registered as if the anatomy had stayed where it was, the C-arm had come back to where it was, the leg
had not turned in its joint, and the device had been held still. The images tell whether that holds: let the anatomy, or
one of its bones, move by a rigid motion y in the images of another kind than the first, in all views at once (the
patient moved) or in one alone (the C-arm did not come back), or let the device, or a bone beside the scene's anchor,
move in one view, and let everything else be refitted. With curvature and scores profiled as those of the intrinsics are
(`registration.evidence.covariance`), the step of Newton is −S⁻¹ Σ r, and its covariance that of the sandwich estimator
over tiles, S⁻¹ R S⁻¹.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.optimize import Quadratic
from femoreg_torch.registration.scene import Kind, Scene

Image = tuple[Kind, int]

# Degrees or mm along each axis of the curvature. Further away the model of the cost does not hold: a femur seen from a
# side, which was right, would have gained by going 18 mm deeper.
_REACH = 3.0
_FLAT = 1e-12  # of the strongest curvature: rounding
_NO_DEVIATION = 1e-9  # degrees or mm: less is rounding, and what did not move by more did not move


@dataclass(frozen=True, eq=False)
class MotionBetween:
    """How objects lie in some images of one kind, beside where they lie in all others."""

    kind: Kind | None  # None: in the images of all kinds
    views: tuple[int, ...]  # from 0, that it was looked for in, all at once
    objects: tuple[str, ...]  # that move together
    motion: Tensor  # (6,) degrees and mm, about the first object's reference point, along the axes of camera 1
    deviation: Tensor  # (6,)
    # by which the motion, or what of it is in reach, lowers the costs of all images together: what has really moved
    # gains the most
    gain: float

    @cached_property
    def size(self) -> tuple[float, float]:
        """Degrees and mm."""
        return float(self.motion[:3].norm()), float(self.motion[3:].norm())

    @cached_property
    def sureness(self) -> float:
        """The motion by its standard deviations: the most certain of its six parts."""
        return float((self.motion.abs() / self.deviation.clamp_min(_NO_DEVIATION)).max())


@dataclass(frozen=True)
class JointTurn:
    """How a bone is turned in its joint in one view, beside where its other views show it."""

    view: int  # from 0
    name: str
    degrees: float
    sureness: float  # the turn by its standard deviations: the most certain of its three parts
    gain: float  # by which it lowers the costs of all images together


@dataclass(frozen=True)
class GuideDrift:
    """How a tool lies in one view along or about its guide, beside where its other views show it."""

    kind: Kind
    view: int  # from 0
    name: str
    turns: bool  # about the guide, by degrees; else it slides along it, towards the tip, by mm
    amount: float
    deviation: float
    gain: float  # by which it lowers the costs of all images together

    @property
    def sureness(self) -> float:
        """The amount by its standard deviation."""
        return abs(self.amount) / self.deviation if self.deviation else 0.0


def motions_between(
    scene: Scene, parts: Sequence[Quadratic], images: Sequence[Image], names: Sequence[str], centres: Tensor
) -> tuple[MotionBetween, ...]:
    """Motions of the anatomy in every kind of images but the first.

    Of all objects of the first kind together in all views, of each by itself, and of all together in each view.
    `parts` are the models of the `images`, one by one. Their first unknowns are motions (degrees, mm) of bodies about
    `centres` (B, 3) mm: of the objects `names` in camera 1, and then of the C-arm; others stay.
    """
    found = []
    for kind in dict.fromkeys(kind for kind, _ in images if kind != scene.first_kind):
        both = {scene.first_kind, kind}
        anatomy = tuple(name for name in names if both <= set(scene.objects[name].shown_in))
        views = tuple(view for k, view in images if k == kind)
        looked_for = [(anatomy, views), *(((name,), views) for name in anatomy), *((anatomy, (v,)) for v in views)]
        for objects, where in dict.fromkeys(each for each in looked_for if each[0]):
            bodies = [names.index(name) for name in objects]
            chosen = [k == kind and view in where for k, view in images]
            found.append(MotionBetween(kind, where, objects, *_step(parts, chosen, _moves(bodies, centres))))
    return tuple(found)


def drifts_between_views(
    scene: Scene, parts: Sequence[Quadratic], images: Sequence[Image], names: Sequence[str], centres: Tensor
) -> tuple[MotionBetween, ...]:
    """Motions in one view of each object but the anchor, beside its other views.

    Of objects that images of the first kind show, in the view's images of all kinds. `parts`, `images`, `names` and
    `centres` are as for `motions_between`.
    """
    found = []
    for kind in dict.fromkeys(kind for kind, _ in images if kind != scene.first_kind):
        views = tuple(view for k, view in images if k == kind)
        for n, name in enumerate(names):
            shown = scene.objects[name].shown_in
            for view in views if kind in shown and scene.first_kind not in shown and len(views) > 1 else ():
                chosen = [each == (kind, view) for each in images]
                found.append(MotionBetween(kind, (view,), (name,), *_step(parts, chosen, _moves([n], centres))))
    views = tuple(dict.fromkeys(view for _, view in images))
    for n, name in enumerate(names):
        if name == scene.anchor or scene.first_kind not in scene.objects[name].shown_in:
            continue
        for view in views if len(views) > 1 else ():
            chosen = [each == view for _, each in images]
            found.append(MotionBetween(None, (view,), (name,), *_step(parts, chosen, _moves([n], centres))))
    return tuple(found)


def turns_in_joints(
    scene: Scene, parts: Sequence[Quadratic], images: Sequence[Image], names: Sequence[str], centres: Tensor
) -> tuple[JointTurn, ...]:
    """Turns of every bone that starts beside the anchor, about its reference point, in one view beside the others.

    A leg turns in its joint, which stays where it is: three unknowns are told more surely than the six of
    `drifts_between_views`, of which the depth is so open. `parts`, `images`, `names` and `centres` are as for
    `motions_between`.
    """
    found = []
    views = tuple(dict.fromkeys(view for _, view in images))
    for n, name in enumerate(names):
        thing = scene.objects[name]
        if thing.start.beside != scene.anchor or scene.first_kind not in thing.shown_in or len(views) < 2:
            continue
        moves = _moves([n], centres)[:, :3]
        for view in views:
            turn, deviation, gain = _step(parts, [each == view for _, each in images], moves)
            sureness = float((turn.abs() / deviation.clamp_min(_NO_DEVIATION)).max())
            found.append(JointTurn(view, name, float(turn.norm()), sureness, gain))
    return tuple(found)


def drifts_along_guides(
    scene: Scene,
    poses: Poses,
    parts: Sequence[Quadratic],
    images: Sequence[Image],
    names: Sequence[str],
    centres: Tensor,
) -> tuple[GuideDrift, ...]:
    """Slides of every tool along its guide, and turns about it, in one view beside its other views.

    A hand that holds a tool lets it slide or turn so most easily. One unknown is told far more surely than the six of
    `drifts_between_views`. Of tools with a known guide; of round ones no turn. `parts`, `images`, `names` and `centres`
    are as for `motions_between`.
    """
    found = []
    for n, name in enumerate(names):
        guide, shown = scene.objects[name].guide, scene.objects[name].shown_in
        views = tuple(dict.fromkeys((kind, view) for kind, view in images if kind in shown))
        if guide is None or scene.first_kind in shown or len(views) < 2:
            continue
        base, tip = transform_points(poses.camera1_from[name], torch.stack(guide))
        axis = (tip - base) / (tip - base).norm()
        turn = torch.cat([axis, torch.linalg.cross(axis, centres[n] - base) * torch.pi / 180])
        slide = torch.cat([torch.zeros_like(axis), axis])
        for turns, way in ((False, slide), (True, turn)):
            moves = torch.zeros(len(centres), 6, 1, dtype=torch.float64)
            moves[n, :, 0] = way
            for kind, view in views if not turns or scene.objects[name].axis is None else ():
                amount, deviation, gain = _step(parts, [each == (kind, view) for each in images], moves.flatten(0, 1))
                found.append(GuideDrift(kind, view, name, turns, float(amount), float(deviation), gain))
    return tuple(found)


def _moves(bodies: Sequence[int], centres: Tensor) -> Tensor:
    """Twists (6 B, 6) of all bodies about their centres when some move as one about the centre of the first of them."""
    moves = torch.zeros(len(centres), 6, 6, dtype=torch.float64)
    for body in bodies:
        moves[body] = torch.eye(6)
        moves[body, 3:, :3] = -skew(centres[body] - centres[bodies[0]]) * torch.pi / 180  # ω × arm
    return moves.flatten(0, 1)


def _step(parts: Sequence[Quadratic], chosen: Sequence[bool], moves: Tensor) -> tuple[Tensor, Tensor, float]:
    """Newton's step (k,) of a motion in the chosen images, all bodies refitted; its deviations (k,), and what it gains.

    `moves` (6 B, k) are the twists of all bodies in each unknown of the motion. The gain is that of a step cut to what
    is in reach; where the cost does not bend up, nothing is gained. Scores vary about their mean over the tiles of each
    image, as a motion gives all of them one sign.
    """
    n = len(moves)
    stay = torch.cat([torch.eye(n, dtype=torch.float64), torch.zeros_like(moves)], 1)  # (n, n + k)
    move = torch.cat([torch.eye(n, dtype=torch.float64), moves], 1)
    ways = [move if here else stay for here in chosen]
    hessian = torch.stack([w.T @ part.hessian[:n, :n] @ w for part, w in zip(parts, ways, strict=True)]).sum(0)
    scores = torch.cat([part.scores[:, :n] @ w for part, w in zip(parts, ways, strict=True)])
    answer = -torch.linalg.pinv(hessian[:n, :n], hermitian=True) @ hessian[:n, n:]
    curvature = hessian[n:, n:] + hessian[n:, :n] @ answer
    inverse = torch.linalg.pinv(curvature, hermitian=True)
    left = scores[:, n:] + scores[:, :n] @ answer
    spread = torch.zeros_like(inverse)
    for tiles in left.split([len(part.scores) for part in parts]):
        apart = tiles - tiles.mean(0)
        spread += len(tiles) / max(1, len(tiles) - 1) * apart.T @ apart
    score = left.sum(0)
    curvatures, axes = torch.linalg.eigh(curvature)
    along = axes.T @ score
    bends = curvatures > _FLAT * curvatures.max()
    within = torch.where(bends, -along / curvatures, torch.zeros_like(along)).clamp(-_REACH, _REACH)
    gain = -(along * within + curvatures * within.square() / 2).sum()
    return -inverse @ score, (inverse @ spread @ inverse).diagonal().clamp_min(0).sqrt(), float(gain)
