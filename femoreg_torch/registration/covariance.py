"""How well the images fix the poses: a covariance of all that was registered, from the derivatives at the end.

The poses are where the scores of all image tiles cancel. Were the images drawn anew, the sum of the scores would vary
by G = Σ s sᵀ, and the poses by H⁻¹ G H⁻¹ with the curvature H: the sandwich estimator with tiles as clusters (White,
Maximum likelihood estimation of misspecified models, Econometrica 50 (1982) 1; Cameron and Miller, A practitioner's
guide to cluster-robust inference, J. Human Resources 50 (2015) 317). It assumes neither a noise model nor independent
pixels, only tiles that do not know of each other. What all tiles share (a wrong calibration, a wrong CT) it cannot see.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import PLAIN, Imaging, image_costs, stage_objective
from femoreg_torch.registration.scene import Body, Kind, Scene, reference_point_in_view
from femoreg_torch.similarity import Similarity

_UNIT_DEG, _UNIT_MM = 1.0, 1.0


@dataclass(frozen=True, eq=False)
class PoseCovariance:
    """Covariance (6 B, 6 B) of the motions of B bodies: of every object in camera 1, and of the C-arm of other views.

    Where the C-arm's poses are known, of the objects alone.

    A motion is a twist (degrees, mm) along the axes of its camera about the object's reference point, for a C-arm about
    that of the first object.
    """

    bodies: tuple[str, ...]  # object names, then "view 2", …
    matrix: Tensor
    step: Tensor  # (6 B,): where all images together would move the bodies, were all free; 0 at their common optimum

    def of(self, first: str, second: str | None = None) -> Tensor:
        """The block (6, 6) of one body, or of two."""
        i, j = (6 * self.bodies.index(name) for name in (first, second or first))
        return self.matrix[i : i + 6, j : j + 6]

    def deviations(self, name: str) -> tuple[list[float], list[float]]:
        """Standard deviations of one body: rotation (3) in degrees, translation (3) in mm."""
        sigma = self.of(name).diagonal().sqrt().tolist()
        return sigma[:3], sigma[3:]

    def pull(self, name: str) -> tuple[float, float]:
        """Degrees and mm that all images together would move one body by, were all bodies free."""
        i = 6 * self.bodies.index(name)
        return float(self.step[i : i + 3].norm()), float(self.step[i + 3 : i + 6].norm())


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
    images: list[tuple[Kind, int]] = [(kind, view) for kind in scene.images for view in views]
    costs = image_costs(scene, poses, tuple(bodies), objects, images, level, similarity, imaging=imaging)
    model = stage_objective(costs, tuple(bodies), None).quadratic(torch.zeros(6 * len(bodies), dtype=torch.float64))
    inverse = torch.linalg.pinv(model.hessian, hermitian=True)
    clusters = len(model.scores) / (len(model.scores) - 1)
    matrix = clusters * inverse @ (model.scores.T @ model.scores) @ inverse
    return PoseCovariance((*objects, *(f"view {view + 1}" for view in found)), matrix, -inverse @ model.gradient)
