"""Do the images tell the turn of an object about its long axis, as far as they show it, and about its guide?

Derivatives do not say so: voxels of a round guide are not quite round, and what that draws looks like knowledge of the
turn. So the object is turned far, about the long axis of what is in view of it, and the similarity must fall. The two
axes are not the same: of a drill whose grip was hardly in view they were 6° apart, and a turn about the one swept the
bit aside (0.066), where about the other everything fitted as well (0.0001), and the drill was 6.7° off.
"""

import math

import torch
from torch import Tensor

from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Body, Scene, in_view
from femoreg_torch.similarity import Similarity

TOLD = 0.008
"""Of mean patch NCC: what a turn must lose at least to be told.

Four simulated devices lost 0.16 to 0.21. A round guide whose handle no image showed lost 0.003 at most, by voxels that
are not quite round.
"""

_TURNS_DEG = -20.0, 20.0, 180.0
_FILLED = 0.004  # 1/mm: a fifth of water
_MOST_POINTS = 20_000


def losses_by_turning(
    scene: Scene, poses: Poses, name: str, level: Level, similarity: Similarity, imaging: Imaging
) -> tuple[float, float]:
    """What the images lose of their mean similarity, at least, if an object is turned about its long axis; its guide.

    Infinite where no image shows it, and about a guide that is not known. nan where a similarity is.
    """
    points = _points_in_view(scene, poses, name)
    if len(points) < 2:
        return math.inf, math.inf
    images, drawn = scene.there(scene.objects[name].shown_in, range(scene.views)), tuple(poses.camera1_from)
    turns = torch.tensor([0, *_TURNS_DEG], dtype=torch.float64)[:, None]

    def loss(through: Tensor, along: Tensor) -> float:
        """About the line through a point (3,) along a direction (3,) in camera 1."""
        body = Body((name,), 0, through, torch.tensor([math.pi / 180] * 3 + [0] * 3, dtype=torch.float64))
        costs = image_costs(scene, poses, (body,), drawn, images, level, similarity, imaging=imaging)
        found = costs(turns * along).mean(1)
        return float((found[1:] - found[0]).min())

    about_long_axis = loss(points.mean(0), long_axis(points))
    guide = scene.objects[name].guide
    if guide is None:
        return about_long_axis, math.inf
    base, tip = transform_points(poses.camera1_from[name], torch.stack(guide))
    return about_long_axis, loss(base, (tip - base) / (tip - base).norm())


def long_axis(points: Tensor) -> Tensor:
    """The direction (3,) that points (N, 3) lie along; of flat things, that across them."""
    away = points - points.mean(0)
    moments, axes = torch.linalg.eigh(away.T @ away)
    return axes[:, 2 if moments[2] - moments[1] > moments[1] - moments[0] else 0]


def _points_in_view(scene: Scene, poses: Poses, name: str) -> Tensor:
    """Filled voxels (N, 3) of an object, mm in camera 1, that an exposed pixel of some image shows."""
    points = scene.objects[name].volume.points_above(_FILLED, _MOST_POINTS)
    return transform_points(poses.camera1_from[name], points[in_view(scene, poses, name, points)])
