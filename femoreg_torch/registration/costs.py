"""What images cost as functions of how bodies move: each by itself, with derivatives (paper, equations 1, 3, 4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from femoreg_torch.cores import on_all_cores, shares
from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, Poses, transform_points, twist_rates
from femoreg_torch.optimize import Quadratic
from femoreg_torch.registration.imaging import (
    PLAIN,
    Imaging,
    below_white,
    below_white_slope,
    draw,
    draw_with_jacobian,
    filled_slope,
    hardened_slope,
)
from femoreg_torch.registration.intrinsics import Intrinsics
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Body, Kind, Moving, RigidObject, Scene, motions, split
from femoreg_torch.registration.target import Target, target_of
from femoreg_torch.registration.weights import Weighting
from femoreg_torch.similarity import FixedSimilarity, Similarity, similarity_quadratics
from femoreg_torch.volume import Volume

_STEP = 1e-5  # of a delta, for the derivatives of poses
_DEFORMED = 0.005  # of a shape, for what is drawn: edges of a pelvis move by half a millimetre


@dataclass(frozen=True, eq=False)
class ImageCosts:
    """Similarity costs of images as functions of deltas (P, Σ n_b) of bodies; made by `image_costs`."""

    objects: dict[str, RigidObject]
    poses: Poses
    bodies: tuple[Moving, ...]
    step_mm: float
    targets: tuple[Target, ...]

    def __call__(self, deltas: Tensor) -> Tensor:
        """Costs (P, images) of deltas (P, Σ n_b), on the CPU; a device is waited for once."""
        motions = self._motions(deltas)
        one_by_one = bool(self._intrinsics(deltas))  # one camera draws a batch
        parts = [slice(n, n + 1) for n in range(len(deltas))] if one_by_one else shares(len(deltas), self._device)
        views = list(dict.fromkeys(target.view for target in self.targets))
        jobs = [(part, view) for part in parts for view in views]
        found = on_all_cores(lambda job: self._costs(deltas, motions, *job), jobs, self._device)
        by_view = {
            view: iter(torch.cat([values for (_, of), values in zip(jobs, found, strict=True) if of == view]).unbind(1))
            for view in views
        }
        return torch.stack([next(by_view[target.view]) for target in self.targets], 1).cpu()

    @property
    def _device(self) -> torch.device:
        return self.targets[0].background.device

    @property
    def still(self) -> Tensor:
        """The delta (Σ n_b,) that moves nothing."""
        return torch.zeros(sum(len(body.free) for body in self.bodies), dtype=torch.float64)

    def with_object(self, name: str, thing: RigidObject) -> "ImageCosts":
        """The same images with another object in the place of one that moves."""
        return replace(self, objects=self.objects | {name: thing})

    def in_parts(
        self, name: str, parts: Mapping[str, RigidObject], poses: Poses, bodies: tuple[Body, ...]
    ) -> "ImageCosts":
        """The same images with parts of one that moves in its place, which lie at `poses` and are moved by `bodies`."""

        def moving(names: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(each for one in names for each in (parts if one == name else (one,)))

        targets = tuple(replace(target, moving=moving(target.moving)) for target in self.targets)
        return replace(self, objects=self.objects | dict(parts), poses=poses, bodies=bodies, targets=targets)

    def without_what_moves(self) -> Tensor:
        """Costs (images,) of what stands still alone."""
        return torch.cat([target.cost(target.background[None]) for target in self.targets]).cpu()

    def quadratics(
        self,
        delta: Tensor,
        unsure: Sequence[tuple[str, Volume]] = (),
        shapes: Sequence[Mapping[str, Tensor]] = (),
        bends: Sequence[Mapping[int, Tensor]] = (),
    ) -> list[Quadratic]:
        """Each image's cost about one delta (Σ n_b,), with exact gradient and positive semi-definite curvature.

        The next unknowns are the amounts of what is `unsure`, differences that come to the volumes of objects by name.
        Then those of the `shapes`: by each, objects are deformed at once, by name at the rate (4, 4) by which points of
        their space move. The last are those of the `bends`: by each, what is drawn moves in the picture, by view at the
        rate (2, H, W), along columns and rows, px. All of it on the CPU; a device is waited for once.
        """
        steps = _STEP * torch.eye(len(delta), dtype=torch.float64)
        for _, chosen in self._intrinsics(torch.eye(len(delta), dtype=torch.float64)):
            steps = steps - _STEP * chosen @ chosen.T
        around = torch.cat([delta[None], delta + steps, delta - steps])  # (1 + 2 n, n)
        motions = self._motions(around)
        moving = [target for target in self.targets if target.moving]
        placed = [self._placed_with_rates(target, around, motions) for target in moving]
        # What images of one view show alike is drawn once.
        wanted: dict[tuple[int, str], tuple[Target, Tensor]] = {}
        for target, (poses, _) in zip(moving, placed, strict=True):
            for name, pose in zip(target.moving, poses, strict=True):
                wanted.setdefault((target.view, name), (target, pose))
        jobs = list(wanted.items())
        if len(jobs) <= 2:  # of unlike sizes, so that one core would wait; a kernel by itself uses all of them
            drawn = [self._image_and_jacobian(delta, each) for each in jobs]
        else:
            drawn = on_all_cores(lambda each: self._image_and_jacobian(delta, each), jobs, self._device)
        seen = dict(zip(wanted, drawn, strict=True))
        about = [
            partial(self._changes, target, delta, poses, seen, unsure, shapes, bends)
            for target, (poses, _) in zip(moving, placed, strict=True)
        ]
        found = iter(zip(similarity_quadratics(about, self._device), placed, strict=True))
        models = []
        for target in self.targets:
            if target.moving:
                (cost, scores, hessian), (_, twists) = next(found)
                others = len(shapes) + len(bends)
                amounts = torch.eye(len(unsure) + others, dtype=torch.float64)
                shown = amounts[[name in target.moving for name, _ in unsure] + [True] * others]
                ways = torch.block_diag(twists, shown) if len(amounts) else twists
                models.append(Quadratic(cost, scores @ ways, ways.T @ hessian @ ways))
            else:
                unknowns = len(delta) + len(unsure) + len(shapes) + len(bends)
                nothing = delta.new_zeros(unknowns, unknowns)
                models.append(Quadratic(float(target.cost(target.background[None])), nothing[:1], nothing))
        return models

    def _costs(self, every: Tensor, motions: Sequence[tuple[Body, Tensor]], part: slice, view: int) -> Tensor:
        """Costs (p, images) of one view for a part of deltas (P, Σ n_b), which has the intrinsics of its first one.

        What the view's images show alike is drawn once.
        """
        costs = []
        deltas, motions = every[part], [(body, motion[part]) for body, motion in motions]
        names: tuple[str, ...] = ()  # of what was drawn last
        moving = torch.zeros(())
        for target in self.targets:
            if target.view != view:
                continue
            image = target.background.expand(len(deltas), *target.camera.shape)
            if target.moving:
                if not set(names) <= set(target.moving):
                    names, moving = (), torch.zeros(())
                left = [name for name in target.moving if name not in names]
                if left:
                    things = [self.objects[name] for name in left]
                    placed = self._placed(target, deltas, motions, left)
                    moving = moving + draw(things, placed, self._camera(target, deltas), self.step_mm)
                names = target.moving
                image = image + moving
            costs.append(target.cost(image))
        return torch.stack(costs, 1)

    def _intrinsics(self, deltas: Tensor) -> list[tuple[Intrinsics, Tensor]]:
        """The intrinsics among the bodies, with their part of the deltas (P, n): one or none."""
        parts = zip(self.bodies, split(deltas, self.bodies), strict=True)
        return [(body, part) for body, part in parts if isinstance(body, Intrinsics)]

    def _camera(self, target: Target, deltas: Tensor) -> Camera:
        """The camera at the first of the deltas."""
        camera = target.camera
        for intrinsics, part in self._intrinsics(deltas):
            camera = camera.changed(intrinsics.changes(part[0])[target.view])
        return camera

    def _motions(self, deltas: Tensor) -> list[tuple[Body, Tensor]]:
        """The rigid bodies with their motions (P, 4, 4)."""
        parts = zip(self.bodies, split(deltas, self.bodies), strict=True)
        rigid = [(body, part) for body, part in parts if isinstance(body, Body)]
        bodies = [body for body, _ in rigid]
        return list(zip(bodies, motions(bodies, [part for _, part in rigid]), strict=True))

    def _placed(
        self, target: Target, deltas: Tensor, motions: Sequence[tuple[Body, Tensor]], names: Sequence[str]
    ) -> Tensor:
        """Poses (P, O, 4, 4) of moving objects in the target's view."""
        placed = [_camera_from(name, target.view, self.poses, motions, len(deltas)) for name in names]
        for intrinsics, part in self._intrinsics(deltas):
            placed = [intrinsics.slides(part)[:, target.view] @ pose for pose in placed]
        return torch.stack(placed, 1)

    def _placed_with_rates(
        self, target: Target, around: Tensor, motions: Sequence[tuple[Body, Tensor]]
    ) -> tuple[Tensor, Tensor]:
        """Poses (O, 4, 4) of what moves in an image, and the changes (m, n) of all that is seen by n deltas.

        They are taken at the first of deltas (1 + 2 n, n), the others being steps up and down from it. Six twists per
        object, and three intrinsics of the view, span all that the deltas do to an image: m = 6 O, or 6 O + 3.
        """
        n = around.shape[1]
        every = self._placed(target, around, motions, target.moving).movedim(1, 0)  # (O, 1 + 2 n, 4, 4)
        # Derivatives (O, n, 4, 4) of the poses by the bodies' motions, by central differences, good to some 1e-9.
        rates = (every[:, 1 : n + 1] - every[:, n + 1 :]) / (2 * _STEP)
        points = torch.stack([self.objects[name].reference_point for name in target.moving])
        centres = transform_points(every[:, 0], points[:, None])[:, 0]
        twists = [twist_rates(rates, every[:, 0], centres).flatten(0, 1)]
        for intrinsics, chosen in self._intrinsics(torch.eye(n, dtype=torch.float64)):
            twists.append(intrinsics.by_delta(target.view) @ chosen.T)
        return every[:, 0], torch.cat(twists)

    def _image_and_jacobian(
        self, delta: Tensor, where: tuple[tuple[int, str], tuple[Target, Tensor]]
    ) -> tuple[Tensor, Tensor]:
        """What one object at a pose (4, 4) shows to a view at a delta (n,), (H, W), and its changes (m, H, W)."""
        (_, name), (target, pose) = where
        centre = transform_points(pose, self.objects[name].reference_point[None])[0]
        refining = bool(self._intrinsics(delta[None]))
        camera = self._camera(target, delta[None])
        image, jacobian = draw_with_jacobian(
            self.objects[name], pose[None], camera, centre, self.step_mm, intrinsics=refining
        )
        return image[0], jacobian[0].movedim(-1, 0)

    def _changes(
        self,
        target: Target,
        delta: Tensor,
        poses: Tensor,
        seen: dict[tuple[int, str], tuple[Tensor, Tensor]],
        unsure: Sequence[tuple[str, Volume]],
        shapes: Sequence[Mapping[str, Tensor]],
        bends: Sequence[Mapping[int, Tensor]],
    ) -> tuple[FixedSimilarity, Tensor, Tensor]:
        """The similarity of an image, what is drawn at a delta (n,), and its changes (H, W, m).

        By the twists, by what is `unsure` of what moves, by the `shapes` and by the `bends`. What moves lies at `poses`
        (O, 4, 4). `seen` holds each object by itself in each view.
        """
        drawn, jacobians = target.background, []
        camera = self._camera(target, delta[None])
        refining = [intrinsics for intrinsics, _ in self._intrinsics(delta[None])]
        by_rays = target.background.new_zeros(3, *camera.shape)  # derivatives by the intrinsics
        for name in target.moving:
            image, planes = seen[target.view, name]
            drawn = drawn + image
            jacobians.append(planes[:6])
            for intrinsics in refining:
                sliding = intrinsics.slide_rates(target.view, camera.sdd_mm).to(planes.dtype)
                sliding = sliding.to(planes.device, non_blocking=True)
                by_rays = by_rays + planes[6:] + torch.tensordot(sliding, planes[3:6], 1)
        jacobians += [by_rays] * len(refining)
        for name, difference in unsure:
            if name in target.moving:
                place = poses[target.moving.index(name)][None, None]
                change = project([difference], place, camera, self.step_mm)
                jacobians.append(change * hardened_slope(seen[target.view, name][0], self.objects[name].hardening))
        for rates in shapes:
            change = torch.zeros_like(target.background)[None]
            for name, pose in zip(target.moving, poses, strict=True):
                if name in rates:
                    rate = _DEFORMED * rates[name]
                    deformed = pose @ torch.stack([torch.eye(4) + rate, torch.eye(4) - rate])
                    more, less = draw([self.objects[name]], deformed[:, None], camera, self.step_mm)
                    change = change + (more - less) / (2 * _DEFORMED)
            jacobians.append(change)
        if bends:
            downwards, across = torch.gradient(drawn)
            jacobians += [
                -(across * along[0] + downwards * along[1])[None]
                if (along := rates.get(target.view)) is not None
                else torch.zeros_like(drawn)[None]
                for rates in bends
            ]
        changes = torch.cat(jacobians)
        if target.scatter is not None:
            changes *= filled_slope(below_white(drawn, target.white), target.scatter)
        if target.white is not None:
            changes *= below_white_slope(drawn, target.white)
        return target.similarity, target.seen(drawn), changes.movedim(0, -1)


def image_costs(
    scene: Scene,
    poses: Poses,
    bodies: tuple[Moving, ...],
    render: Sequence[str],
    images: Sequence[tuple[Kind, int]],
    level: Level,
    similarity: Similarity,
    weights: Sequence[Weighting] = (),
    imaging: Imaging = PLAIN,
) -> ImageCosts:
    """Similarity costs of `images`, (kind, view) pairs, as functions of deltas (P, Σ n_b) of the bodies.

    Objects of `render` that no body moves are drawn once and added. `weights` says which pixels count, see
    `pixel_weights`, by default all. Raises `InputError` for an image that they leave no pixel of.
    """
    fitting = {
        name: replace(thing, volume=level.volume(thing.volume, sharp=thing.sharp))
        for name, thing in scene.objects.items()
    }
    scene = replace(scene, objects=fitting)

    def target(image: tuple[Kind, int]) -> Target:
        return target_of(scene, poses, bodies, render, image, level, similarity, weights, imaging)

    targets = on_all_cores(target, images, scene.device)
    return ImageCosts(scene.objects, poses, bodies, level.step_mm, tuple(targets))


def _camera_from(name: str, view: int, poses: Poses, motions: Sequence[tuple[Body, Tensor]], candidates: int) -> Tensor:
    """Poses (P, 4, 4) of one object in one view for every candidate."""
    in_camera1 = poses.camera1_from[name].expand(candidates, 4, 4)
    camera = poses.camera_from_camera1[view].expand(candidates, 4, 4)
    for body, motion in motions:
        if name in body.objects:
            in_camera1 = motion @ in_camera1
        if body.view and body.view == view:
            camera = motion @ camera
    return camera @ in_camera1
