"""Are the pictures straight? The bones in all views are asked how pictures would have to be bent to show them.

An image intensifier stretches pictures towards their rim, and the earth's field twists them, in each view otherwise.
Halves of a detector may be put together wrongly. Bones then fit no pose, and seem to have moved or turned: all poses
are refitted here. A way to bend that seems likely is looked at twice: the pictures are made straight, and the bones
compared with them again.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Camera, Poses
from femoreg_torch.optimize import profile
from femoreg_torch.registration.evidence.bones import LEVEL, Amount, costs_of_bones, refitted
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.objective import mean_quadratic
from femoreg_torch.registration.scene import Scene

Field = Callable[[Camera], Tensor]  # by how much what a picture shows is moved along columns and rows (2, H, W)
_WHOLE = 0.999  # of a pixel exposed


@dataclass(frozen=True)
class Way:
    """One way in which pictures may be bent, by one or several amounts in mm on the detector."""

    name: Literal["rim", "twist", "columns", "rows"]
    fields: tuple[Mapping[int, Field], ...]  # of each amount: of the views (from 0) that it bends
    least_mm: float  # of an amount that is looked at twice


@dataclass(frozen=True)
class Bend:
    """How the pictures seem to be bent in one way, and by how much less they cost straightened."""

    way: Way
    amounts: tuple[Amount, ...]  # mm on the detector
    gain: float  # share of the costs of all first images that is saved


def towards_the_rim(camera: Camera) -> Tensor:
    """Outwards, with the cube of the distance from the middle: by one where the wider side of the picture ends."""
    places, radius = _from_the_middle(camera)
    return places.square().sum(0) / radius**3 * places


def twisted(camera: Camera) -> Tensor:
    """About the middle, from columns to rows, with the cube of the distance: by one where the wider side ends."""
    x, y = towards_the_rim(camera)
    return torch.stack([-y, x])


def half(axis: int, along: int) -> Field:
    """The half beyond the middle of the columns (axis 0) or rows (1), moved by one along columns (0) or rows (1)."""

    def field(camera: Camera) -> Tensor:
        places, _ = _from_the_middle(camera)
        moved = torch.zeros_like(places)
        moved[along] = (places[axis] > 0).to(moved)
        return moved

    return field


def bent_pictures(scene: Scene, poses: Poses, names: Sequence[str], imaging: Imaging) -> tuple[Bend, ...]:
    """Every way in which the pictures seem to be bent by more than little, by the bones `names` of a CT.

    A step of Newton in the amounts of each way, with the poses refitted. Then the pictures are straightened by these,
    the poses refitted by what they show, and the rest is added. Deviations are those of the sandwich estimator over
    tiles there, see `registration.evidence.covariance`. Nothing where fewer than two views show the anchor.
    """
    costs = costs_of_bones(scene, poses, names, imaging)
    if costs is None:
        return ()
    views = [target.view for target in costs.targets]
    ways = _ways(views)
    rates = [rate for way in ways for rate in _rates(way, scene)]
    model = profile(mean_quadratic(costs.quadratics(costs.still, bends=rates)), len(rates))
    likely, first = [], 0
    for way in ways:
        own = slice(first, first + len(way.fields))
        first = own.stop
        steps = torch.linalg.pinv(model.curvature[own, own], hermitian=True) @ -model.scores[:, own].sum(0)
        if float(steps.abs().max()) > way.least_mm:
            likely.append((way, steps))
    looked = on_all_cores(lambda each: _looked_at_twice(scene, poses, names, imaging, *each), likely, scene.device)
    return tuple(bend for bend in looked if bend is not None)


def _ways(views: Sequence[int]) -> tuple[Way, ...]:
    every = dict.fromkeys(views)
    halves = {axis: tuple(dict.fromkeys(every, half(axis, along)) for along in (0, 1)) for axis in (0, 1)}
    return (
        Way("rim", tuple({view: towards_the_rim} for view in views), 2.0),
        Way("twist", tuple({view: twisted} for view in views), 1.5),
        Way("columns", halves[0], 0.7),
        Way("rows", halves[1], 0.7),
    )


def _looked_at_twice(
    scene: Scene, poses: Poses, names: Sequence[str], imaging: Imaging, way: Way, steps: Tensor
) -> Bend | None:
    """What the pictures say once they are straightened by `steps` (n,) of a way, mm; None where too little is left."""
    rates = _rates(way, scene)
    straight, as_they_are = _straightened(scene, way, steps.tolist())
    after, before = (refitted(each, poses, names, imaging, bends=rates) for each in (straight, as_they_are))
    if after is None or before is None:
        return None
    amounts = tuple(map(Amount, (steps + after.left).tolist(), after.deviations.tolist()))
    return Bend(way, amounts, (before.cost - after.cost) / before.cost)


def _straightened(scene: Scene, way: Way, amounts_mm: Sequence[float]) -> tuple[Scene, Scene]:
    """The scene with straightened first images, and with those that it has, where both are exposed."""
    kind, camera = scene.first_kind, scene.carm.camera
    straight, exposed = list(scene.images[kind]), [scene.field(kind, view) for view in range(scene.views)]
    for view, image in enumerate(straight):
        moved = [mm * field[view](camera) for mm, field in zip(amounts_mm, way.fields, strict=True) if view in field]
        if image is None or not moved:
            continue
        places = _from_the_middle(camera)[0] + torch.stack(moved).sum(0)
        unit = (2 * places / _size(camera)).movedim(0, -1)[None].to(image)  # the picture from edge to edge: −1 … 1
        field = exposed[view]
        whole = torch.ones_like(image) if field is None else field.to(image)
        seen = F.grid_sample(whole[None, None], unit, align_corners=False)[0, 0] > _WHOLE
        straight[view] = F.grid_sample(image[None, None], unit, padding_mode="border", align_corners=False)[0, 0]
        exposed[view] = seen & (whole > _WHOLE)
    fields = scene.fields | {kind: tuple(exposed)}
    return replace(scene, images=scene.images | {kind: tuple(straight)}, fields=fields), replace(scene, fields=fields)


def _rates(way: Way, scene: Scene) -> list[dict[int, Tensor]]:
    """Of amounts of a way in mm, px by view (2, H, W)."""
    camera = LEVEL.camera(scene.carm.camera)
    return [
        {view: (field(camera) / _pixel(camera)).to(scene.device) for view, field in fields.items()}
        for fields in way.fields
    ]


def _from_the_middle(camera: Camera) -> tuple[Tensor, float]:
    """Places (2, H, W) of the pixels along columns and rows from the middle of the picture, and half its wider side."""
    rows, columns = (torch.arange(n) - (n - 1) / 2 for n in camera.shape)
    down, across = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([across, down]) * _pixel(camera), float(_size(camera).max()) / 2


def _size(camera: Camera) -> Tensor:
    """Of a picture, along columns and rows (2, 1, 1), mm."""
    return torch.tensor(camera.shape[::-1])[:, None, None] * _pixel(camera)


def _pixel(camera: Camera) -> Tensor:
    """Of a pixel, along columns and rows (2, 1, 1), mm."""
    return torch.tensor(camera.pixel_mm[::-1])[:, None, None]
