"""The objective of a stage: mean similarity cost of a batch of candidate deltas (paper, equations 1, 3, 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.geometry import Camera, Poses, invert_rigid, transform_points
from femoreg_torch.optimize import Quadratic, SmoothObjective
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.scene import Body, Kind, RigidObject, Scene, split
from femoreg_torch.registration.weights import Weighting, pixel_weights
from femoreg_torch.similarity import FixedSimilarity, Similarity, similarity_quadratic
from femoreg_torch.volume import Volume

_STEP = 1e-5  # of a delta, for the derivatives of poses
_TISSUE = Level(pixel_mm=3.1, step_mm=3.0)  # how finely the soft tissue is drawn; it is smooth


@dataclass(frozen=True)
class Imaging:
    """How the images differ from plain line integrals of the objects.

    `scatter` is the scattered light per primary light behind the patient but for what is drawn: it fills dark shadows,
    so that −log flattens there, and their edges seem to lie farther out. `tissue` is the soft tissue's attenuation in
    the images per attenuation in the CT (harder light); 0 draws none, nor does a scene without a CT.
    """

    scatter: float = 0.0
    tissue: float = 0.0

    def image(self, integrals: Tensor) -> Tensor:
        """What is seen of line integrals."""
        return -((-integrals).exp() + self.scatter).log() if self.scatter else integrals

    def slope(self, integrals: Tensor) -> Tensor:
        """Its derivative by them."""
        return 1 / (1 + self.scatter * integrals.exp())


PLAIN = Imaging()


@dataclass(frozen=True)
class Prior:
    """R(θ) of equation 1: the penalty weight · ½ (|rotation|² / σ² + |translation|² / σ²) on each body's motion."""

    rotation_deg: float
    translation_mm: float
    weight: float


@dataclass(frozen=True, eq=False)
class _Target:
    """One fixed image with what is drawn into it."""

    view: int
    camera: Camera
    similarity: FixedSimilarity
    background: Tensor  # (H, W), line integrals of all that stands still
    moving: tuple[str, ...]
    tissue: Tensor | None  # (H, W): seen besides, or nothing
    imaging: Imaging

    def cost(self, drawn: Tensor) -> Tensor:
        """Costs (P,) of line integrals (P, H, W)."""
        return self.similarity(self.seen(drawn))

    def seen(self, drawn: Tensor) -> Tensor:
        """Images (..., H, W) of line integrals."""
        image = self.imaging.image(drawn)
        return image if self.tissue is None else image + self.tissue


def _target(
    scene: Scene,
    poses: Poses,
    bodies: Sequence[Body],
    render: Sequence[str],
    image: tuple[Kind, int],
    level: Level,
    similarity: Similarity,
    weights: Sequence[Weighting],
    imaging: Imaging,
) -> _Target:
    kind, view = image
    camera = level.camera(scene.carm.camera)
    fixed = level.image(scene.images[kind][view], scene.carm.camera)
    drawn = scene.shown(render, kind)
    moves = {name for body in bodies for name in (drawn if body.view == view and body.view else body.objects)}
    still = [name for name in drawn if name not in moves]
    background = torch.zeros(camera.shape)
    if still:
        where = torch.stack([poses.camera_from(name)[view] for name in still])[None]
        background = project([scene.objects[name].volume for name in still], where, camera, level.step_mm)[0]
    placing = [name for body in bodies for name in body.objects]
    looked_at = pixel_weights(scene, poses, render, placing, image, camera, level.step_mm, weights)
    prepared = similarity.against(fixed, looked_at)
    tissue = None
    if imaging.tissue and scene.tissue is not None:
        tissue = imaging.tissue * _tissue(scene.tissue, poses.camera_from(scene.anchor)[view], camera)
    return _Target(view, camera, prepared, background, tuple(n for n in drawn if n in moves), tissue, imaging)


def _tissue(tissue: Volume, camera_from_tissue: Tensor, camera: Camera) -> Tensor:
    """Line integrals (H, W) of the soft tissue: on coarse pixels, and interpolated."""
    factor = binning(_TISSUE.pixel_mm, camera)
    rows, columns = (-(-n // factor) * factor for n in camera.shape)
    wide = replace(camera, shape=(rows, columns)).downsampled(factor)
    coarse = project([tissue], camera_from_tissue[None, None], wide, _TISSUE.step_mm)
    fine = F.interpolate(coarse[None], size=(rows, columns), mode="bicubic", antialias=True)[0, 0]
    return fine[: camera.shape[0], : camera.shape[1]].contiguous()


@dataclass(frozen=True, eq=False)
class ImageCosts:
    """Similarity costs of images as functions of deltas (P, Σ n_b) of bodies; made by `image_costs`."""

    objects: dict[str, RigidObject]
    poses: Poses
    bodies: tuple[Body, ...]
    step_mm: float
    targets: tuple[_Target, ...]

    def __call__(self, deltas: Tensor) -> Tensor:
        """Costs (P, images) of deltas (P, Σ n_b)."""
        columns = []
        for target in self.targets:
            drawn = target.background.expand(len(deltas), *target.camera.shape)
            if target.moving:
                volumes = [self.objects[name].volume for name in target.moving]
                drawn = drawn + project(volumes, self._placed(target, deltas), target.camera, self.step_mm)
            columns.append(target.cost(drawn))
        return torch.stack(columns, 1)

    def quadratics(self, delta: Tensor) -> list[Quadratic]:
        """Each image's cost about one delta (Σ n_b,), with exact gradient and positive semi-definite curvature."""
        return [self._quadratic(target, delta) for target in self.targets]

    def _placed(self, target: _Target, deltas: Tensor) -> Tensor:
        """Poses (P, O, 4, 4) of the target's moving objects."""
        motions = [body.motion(part) for body, part in zip(self.bodies, split(deltas, self.bodies), strict=True)]
        placed = [
            _camera_from(name, target.view, self.poses, self.bodies, motions, len(deltas)) for name in target.moving
        ]
        return torch.stack(placed, 1)

    def _quadratic(self, target: _Target, delta: Tensor) -> Quadratic:
        n = len(delta)
        if not target.moving:
            cost = float(target.cost(target.background[None]))
            return Quadratic(cost, delta.new_zeros(1, n), delta.new_zeros(n, n))
        drawn, jacobians, twists = target.background, [], []
        placed = self._placed(target, delta[None])[0]  # (O, 4, 4)
        for name, pose, change in zip(target.moving, placed, self._changes(target, delta), strict=True):
            volume = self.objects[name].volume
            centre = transform_points(pose, self.objects[name].reference_point[None])[0]
            image, jacobian = project_with_jacobian(volume, pose[None], target.camera, centre, self.step_mm)
            drawn = drawn + image[0]
            jacobians.append(jacobian[0])
            twists.append(_twists(change, pose, centre))
        # Six twists per object span all that the deltas do to this image.
        changes = torch.cat(jacobians, -1) * target.imaging.slope(drawn)[..., None]
        cost, scores, hessian = similarity_quadratic(target.similarity, target.seen(drawn), changes)
        by_delta = torch.cat(twists)  # (6 O, n)
        return Quadratic(cost, scores @ by_delta, by_delta.T @ hessian @ by_delta)

    def _changes(self, target: _Target, delta: Tensor) -> Tensor:
        """Derivatives (O, n, 4, 4) of the poses by the deltas, by central differences, good to some 1e-9."""
        steps = _STEP * torch.eye(len(delta), dtype=torch.float64)
        placed = self._placed(target, torch.cat([delta + steps, delta - steps]))  # (2 n, O, 4, 4)
        above, below = placed.chunk(2)
        return ((above - below) / (2 * _STEP)).movedim(0, 1)


def _twists(changes: Tensor, pose: Tensor, centre: Tensor) -> Tensor:
    """Twists (6, n) about `centre` (3,) in the camera frame that belong to changes (n, 4, 4) of a pose (4, 4)."""
    velocity = changes @ invert_rigid(pose)  # (n, 4, 4): of points in the camera frame
    spin = velocity[:, :3, :3]
    rotation = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])
    return torch.cat([rotation, (spin @ centre + velocity[:, :3, 3]).T])


def image_costs(
    scene: Scene,
    poses: Poses,
    bodies: tuple[Body, ...],
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
    targets = tuple(
        _target(scene, poses, bodies, render, image, level, similarity, weights, imaging) for image in images
    )
    return ImageCosts(scene.objects, poses, bodies, level.step_mm, targets)


def _camera_from(
    name: str, view: int, poses: Poses, bodies: tuple[Body, ...], motions: list[Tensor], candidates: int
) -> Tensor:
    """Poses (P, 4, 4) of one object in one view for every candidate."""
    in_camera1 = poses.camera1_from[name].expand(candidates, 4, 4)
    camera = poses.camera_from_camera1[view].expand(candidates, 4, 4)
    for body, motion in zip(bodies, motions, strict=True):
        if name in body.objects:
            in_camera1 = motion @ in_camera1
        if body.view and body.view == view:
            camera = motion @ camera
    return camera @ in_camera1


def stage_objective(costs: ImageCosts, bodies: tuple[Body, ...], prior: Prior | None) -> SmoothObjective:
    """Mean cost over the images, plus the prior's penalty on how far each body moves."""
    stiffness = torch.cat([_stiffness(body, prior) for body in bodies])  # (Σ n_b,): the penalty is ½ Σ k δ²

    def values(deltas: Tensor) -> Tensor:
        return costs(deltas).mean(1) + 0.5 * (deltas.square() @ stiffness)

    def quadratic(delta: Tensor) -> Quadratic:
        parts = costs.quadratics(delta)
        penalty = float(0.5 * (delta.square() @ stiffness))
        return Quadratic(
            sum(part.value for part in parts) / len(parts) + penalty,
            torch.cat([*(part.scores / len(parts) for part in parts), (stiffness * delta)[None]]),
            torch.stack([part.hessian for part in parts]).mean(0) + stiffness.diag(),
        )

    return SmoothObjective(values, quadratic)


def _stiffness(body: Body, prior: Prior | None) -> Tensor:
    """Second derivatives (n,) of the prior's penalty by the body's deltas."""
    if prior is None:
        return torch.zeros(len(body.free), dtype=torch.float64)
    sigma = body.scale.new_tensor([prior.rotation_deg * torch.pi / 180] * 3 + [prior.translation_mm] * 3)
    return prior.weight * (body.scale / sigma).square()[body.free]
