"""How well the images fix the poses: a covariance of all that was registered, from the derivatives at the end.

The poses are where the scores of all image tiles cancel. Were the images drawn anew, the sum of the scores would vary
by G = Σ s sᵀ, and the poses by H⁻¹ G H⁻¹ with the curvature H: the sandwich estimator with tiles as clusters (White,
Maximum likelihood estimation of misspecified models, Econometrica 50 (1982) 1; Cameron and Miller, A practitioner's
guide to cluster-robust inference, J. Human Resources 50 (2015) 317). It assumes neither a noise model nor independent
pixels, only tiles that do not know of each other. What all tiles share (a wrong CT) it cannot see. The images of one
view, without and with the device, show the same bones with the same mistakes of the CT: the scores of their tiles at
one place are summed before they are squared, as one cluster. On four simulated procedures such tiles had scores whose
correlation was 0.5 to 0.97 by what moves the bones; taken as independent, 300 procedures' errors of the femur were 1.06
to 1.34 of its deviations in the root mean square.

The C-arm's intrinsics q are nuisance parameters with a prior of covariance 1 in their units. Of them the tiles of every
image count by themselves, and the limits of what is doubted were chosen so. Refitted to other intrinsics, the poses
would answer by J = −Hxx⁻¹ Hxq. What remains of the images with the poses refitted, S = Hqq + Hqx J with scores
r = s_q + Jᵀ s_x, informs of q by S R⁻¹ S with R = Σ r rᵀ, the inverse of their own sandwich. With the
prior this gives a mean m and a covariance P of q. The intrinsics q0 that the poses were found with are off by
P + (m − q0)(m − q0)ᵀ in the mean square, and the covariance of the poses is Hxx⁻¹ G Hxx⁻¹ + J (P + …) Jᵀ. So of
intrinsics that were refined, what the images leave open counts. Of others it also counts how badly the images fit them.

Where the materials of a device were estimated, some of it is taken for what lies beside it
(`registration.materials.device_fit`). These mistakes are nuisance parameters m too, with covariance 1. What the
images say of them, the calibration has used already, so they add Hxx⁻¹ Hxm Hmx Hxx⁻¹.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses
from femoreg_torch.geometry.rigid import skew
from femoreg_torch.optimize import Profile, Quadratic, profile
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.evidence.motion import (
    GuideDrift,
    JointTurn,
    MotionBetween,
    drifts_along_guides,
    drifts_between_views,
    motions_between,
    turns_in_joints,
)
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.intrinsics import Intrinsics
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import mean_quadratic
from femoreg_torch.registration.scene import Body, Moving, Scene, intrinsics_of, reference_point_in_view
from femoreg_torch.similarity import Similarity

_UNIT_DEG, _UNIT_MM = 1.0, 1.0


@dataclass(frozen=True, eq=False)
class PoseCovariance:
    """Covariance (6 B, 6 B) of the motions of B bodies: of every object in camera 1, and of the C-arm of other views.

    Where the C-arm's poses are known, of the objects alone. It holds what is not known of the intrinsics; `images` is
    the part of it without, as if the intrinsics were certain.

    A motion is a twist (degrees, mm) along the axes of its camera about the object's reference point, for a C-arm about
    that of the first object.
    """

    bodies: tuple[str, ...]  # object names, then "view 2", …
    matrix: Tensor
    images: Tensor
    centres: Tensor  # (B, 3) mm: what each body turns about, in its camera
    intrinsics: "IntrinsicsEstimate"
    step: Tensor  # (6 B,): where all images together would move the bodies, were all free with these intrinsics
    motions: tuple[MotionBetween, ...] = ()  # of the anatomy between kinds of images, were it free to move
    drifts: tuple[MotionBetween, ...] = ()  # of every object beside the anchor, in single views
    guide_drifts: tuple[GuideDrift, ...] = ()  # of tools in single views
    joint_turns: tuple[JointTurn, ...] = ()  # of bones that start beside the anchor, in single views

    def of(self, first: str, second: str | None = None) -> Tensor:
        """The block (6, 6) of one body, or of two."""
        i, j = (6 * self.bodies.index(name) for name in (first, second or first))
        return self.matrix[i : i + 6, j : j + 6]

    def deviations(self, name: str) -> tuple[list[float], list[float]]:
        """Standard deviations of one body: rotation (3) in degrees, translation (3) in mm."""
        sigma = self.of(name).diagonal().clamp(min=0).sqrt().tolist()  # below zero by rounding; nan stays
        return sigma[:3], sigma[3:]

    def by_images(self, name: str) -> tuple[list[float], list[float]]:
        """As `deviations`, were the intrinsics certain."""
        i = 6 * self.bodies.index(name)
        sigma = self.images.diagonal()[i : i + 6].clamp(min=0).sqrt().tolist()
        return sigma[:3], sigma[3:]

    def relative_mm(self, name: str, other: str) -> list[float]:
        """Standard deviations (3) along the axes of camera 1 of one object's reference point, seen from another object.

        What moves both together, as a wrong source distance does, does not count.
        """
        response = self._beside(name, other, self.centre(name))[3:]
        return (response @ self.matrix @ response.T).diagonal().clamp(min=0).sqrt().tolist()

    def beside(self, name: str, other: str, point: Tensor, images_only: bool) -> Tensor:
        """Covariance (6, 6) of one object's motion seen from another, at a point (3,) mm in camera 1.

        Of its translation there in mm, then of its rotation in degrees, along the axes of camera 1. What moves both
        together does not count. `images_only`: as if the intrinsics were certain.
        """
        matrix = self.images if images_only else self.matrix
        response = self._beside(name, other, point).roll(3, 0)
        return response @ matrix @ response.T

    def centre(self, name: str) -> Tensor:
        """What a body turns about (3,), mm in its camera."""
        return self.centres[self.bodies.index(name)]

    def pull(self, name: str) -> Tensor:
        """The motion (6,) about its centre, degrees and mm, that all images would give one body, were all free."""
        i = 6 * self.bodies.index(name)
        return self.step[i : i + 6]

    def pull_beside(self, name: str, other: str) -> Tensor:
        """The motion (6,) as of `pull`, of one object seen from another: what moves both together does not count."""
        return self._beside(name, other, self.centre(name)) @ self.step

    def _beside(self, name: str, other: str, point: Tensor) -> Tensor:
        """What takes the motions of all bodies to that of one object seen from another at a point (3,), (6, 6 B)."""
        response = self.matrix.new_zeros(6, len(self.matrix))
        for body, sign in ((name, 1.0), (other, -1.0)):
            i = 6 * self.bodies.index(body)
            response[:3, i : i + 3] += sign * torch.eye(3)
            response[3:, i + 3 : i + 6] += sign * torch.eye(3)
            response[3:, i : i + 3] -= sign * skew(point - self.centres[i // 6]) * torch.pi / 180  # ω × arm
        return response


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """What prior and images say of the intrinsics, in standard deviations of the prior.

    Log source distance, then x and y of the principal point of every view; zeros for what the C-arm's file holds.
    """

    mean: Tensor  # (1 + 2 V,), off from the C-arm's file
    deviation: Tensor  # (1 + 2 V,)


def pose_covariance(
    scene: Scene, poses: Poses, level: Level, similarity: Similarity, imaging: Imaging = PLAIN
) -> PoseCovariance:
    """The covariance of all poses at a solution, from the images of every view at one level, drawn with `imaging`."""
    scale = torch.tensor([_UNIT_DEG * torch.pi / 180] * 3 + [_UNIT_MM] * 3, dtype=torch.float64)
    objects = tuple(poses.camera1_from)
    views = range(len(poses.camera_from_camera1))
    found = views[1:] if scene.camera_from_camera1 is None else ()
    bodies = [Body((name,), 0, reference_point_in_view(scene, poses, name, 0), scale) for name in objects]
    bodies += [Body((), view, reference_point_in_view(scene, poses, objects[0], view), scale) for view in found]
    images = scene.there(scene.images, views)
    refined = intrinsics_of(scene, poses, objects)
    moving: tuple[Moving, ...] = (*bodies, refined)
    costs = image_costs(scene, poses, moving, objects, images, level, similarity, imaging=imaging)
    rigid = 6 * len(bodies)
    unsure = [(name, difference) for name in objects for difference in scene.objects[name].unsure]
    parts = costs.quadratics(torch.zeros(rigid + len(refined.free), dtype=torch.float64), unsure)
    every = mean_quadratic(parts)
    model = _first(every, rigid + len(refined.free))
    inverse = torch.linalg.pinv(model.hessian[:rigid, :rigid], hermitian=True)
    by_materials = inverse @ every.hessian[:rigid, len(model.hessian) :]
    clusters = len(model.scores) / max(1, len(model.scores) - 1)  # one image of one tile has no spread
    scores = _by_place(parts, [view for _, view in images])[:, :rigid]
    of_places = len(scores) / max(1, len(scores) - 1)
    by_images = of_places * inverse @ (scores.T @ scores) @ inverse + by_materials @ by_materials.T
    of_intrinsics = profile(model, len(refined.free))
    mean, spread = _estimate(of_intrinsics, clusters, refined)
    response = of_intrinsics.answer + _slides(refined, poses, bodies)
    off = mean - refined.units_off
    matrix = by_images + response @ (spread + off[:, None] * off) @ response.T
    centres = torch.stack([body.centre for body in bodies])
    estimate = IntrinsicsEstimate(torch.zeros_like(refined.scale), torch.zeros_like(refined.scale))
    estimate.mean[refined.free] = mean
    estimate.deviation[refined.free] = spread.diagonal().sqrt()
    return PoseCovariance(
        (*objects, *(f"view {view + 1}" for view in found)),
        matrix,
        by_images,
        centres,
        estimate,
        -inverse @ model.gradient[:rigid],
        motions_between(scene, parts, images, objects, centres),
        drifts_between_views(scene, parts, images, objects, centres),
        drifts_along_guides(scene, poses, parts, images, objects, centres),
        turns_in_joints(scene, parts, images, objects, centres),
    )


def _first(model: Quadratic, n: int) -> Quadratic:
    """A model of its first n unknowns, the others staying as they are."""
    return Quadratic(model.value, model.scores[:, :n], model.hessian[:n, :n])


def _by_place(parts: Sequence[Quadratic], views: Sequence[int]) -> Tensor:
    """Scores (T, n) of the mean of images, those of one view's images at the same tile summed; `views` has theirs.

    An image that nothing moves in has one tile, without a score.
    """
    found = []
    for view in dict.fromkeys(views):
        of_view = [part.scores / len(parts) for part, where in zip(parts, views, strict=True) if where == view]
        tiles = max(len(scores) for scores in of_view)
        found.append(torch.stack([scores for scores in of_view if len(scores) == tiles]).sum(0))
    return torch.cat(found)


def _estimate(images: Profile, clusters: float, refined: Intrinsics) -> tuple[Tensor, Tensor]:
    """Mean (n,) and covariance (n, n) of the free intrinsics from the images and the prior, in units of the prior."""
    weighed = images.curvature @ torch.linalg.pinv(clusters * images.scores.T @ images.scores, hermitian=True)  # S R⁻¹
    information = weighed @ images.curvature
    spread = torch.linalg.inv(torch.eye(len(weighed), dtype=torch.float64) + (information + information.T) / 2)
    return spread @ (information @ refined.units_off - weighed @ images.scores.sum(0)), spread


def _slides(refined: Intrinsics, poses: Poses, bodies: Sequence[Body]) -> Tensor:
    """Motions (6 B, n) of the bodies, in degrees and mm, that come with the intrinsics: the C-arm slides."""
    cameras = range(len(poses.camera_from_camera1))
    ways = [refined.slide_rates(view).T @ refined.by_delta(view) for view in cameras]  # (3, n) mm in every camera
    rows = ways[0].new_zeros(len(bodies), 6, ways[0].shape[1])
    for row, body in zip(rows, bodies, strict=True):
        turned = poses.camera_from_camera1[body.view, :3, :3] @ ways[0]
        row[3:] = ways[body.view] - turned if body.view else ways[0]
    return rows.flatten(0, 1)
