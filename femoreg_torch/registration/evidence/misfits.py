"""Images that show nothing of what stands where their view was placed, and what would explain them.

A view that is mirrored, of another hip, or taken from farther off than the C-arm is looked for, ends somewhere. What is
asked of it then looks like a leg that turned or a broken bone. So before all else every image is compared with what is
drawn for it. Where one does not fit, it is looked at as another view, and mirrored, turned and inverted.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Camera, Poses, rotation_angle
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.orbit import Draw, Drawn, OrbitSearch, drawn_from, search_orbit
from femoreg_torch.registration.scene import Body, Kind, Scene, reference_point_in_view
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.1, step_mm=2.0)
_SIMILARITY = GradNcc(patch_radius=5)
# Of the similarity of view 1. Seen on simulated procedures: right views 0.83 to 1, from a side too; views that were
# mirrored, turned, or of another patient 0.08 to 0.27.
_FITS = 0.5
# Of view 1 itself, which all else is compared with. In 38 procedures of foreign simulators at least 0.6.
_FITS_AT_ALL = 0.15
# By so much another pose, or another display, fits better. Seen along the orbit: of mirrored and turned views 0.2 to
# 0.5 (one of 0.1), of images of other patients at most 0.02.
_BETTER = 0.15
_SEARCH = OrbitSearch(
    "an image as it may have been stored",
    kinds=[],
    render=[],
    half_range_deg=45,
    step_deg=2,
    level=_LEVEL,
    similarity=_SIMILARITY,
    shift_mm=30,
    further_deg=100,
    further_above=0.6,
)
# What makes an image fit, named as the case has to tell it: one that was stored turned clockwise is turned back.
_CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "mirrored": lambda image: image.flip(1),
    "turned by 180°": lambda image: image.rot90(2),
    "turned by 90°": lambda image: image.rot90(1),
    "turned by 270°": lambda image: image.rot90(3),
    "with bright and dark exchanged": lambda image: image if image.dtype == torch.bool else image.max() - image,
}


@dataclass(frozen=True)
class Misfit:
    """An image that does not fit what is drawn for it."""

    kind: Kind
    view: int  # from 0
    similarity: float  # mean patch Grad-NCC, at most 1
    in_view_1: float  # of the first image of view 1
    as_view: int | None = None  # (from 0) whose pose explains it
    as_stored: str | None = None  # how it is stored, by what makes it fit
    found_deg: float | None = None  # from view 1, where it fits as it is, though it was not found there


def misfits(scene: Scene, poses: Poses, imaging: Imaging) -> tuple[Misfit, ...]:
    """All images that do not fit: of view 1 the first, if it does not; else those that fit less than half as well.

    Of another view whose first image does not fit, that image alone.
    """
    images = scene.there(scene.images, range(scene.views))
    fits = dict(zip(images, _similarities(scene, poses, images, imaging), strict=True))
    first = scene.first_kind
    if not fits[first, 0] >= _FITS_AT_ALL:
        return (Misfit(first, 0, fits[first, 0], fits[first, 0]),)
    least = _FITS * fits[first, 0]
    bad = [(kind, view) for kind, view in images if fits[kind, view] < least]
    bad = [(kind, view) for kind, view in bad if kind == first or fits.get((first, view), 0.0) >= least]
    draw = _drawn_once()
    return tuple(_explained(scene, poses, image, fits, imaging, draw) for image in bad)


def fits_like_view_1(scene: Scene, poses: Poses, view: int, imaging: Imaging) -> bool:
    """Whether the first image of a view (from 0) fits what is drawn for it half as well as that of view 1 or better."""
    images = [(scene.first_kind, 0), (scene.first_kind, view)]
    first, other = _similarities(scene, poses, images, imaging)
    return first >= _FITS_AT_ALL and other >= _FITS * first


def _explained(
    scene: Scene,
    poses: Poses,
    image: tuple[Kind, int],
    fits: dict[tuple[Kind, int], float],
    imaging: Imaging,
    draw: Draw,
) -> Misfit:
    kind, view = image
    found = Misfit(kind, view, fits[image], fits[scene.first_kind, 0])
    if kind != scene.first_kind:
        return _explained_at_known_view(scene, poses, found, imaging)
    if scene.camera_from_camera1 is not None:
        return found
    ways = _ways(scene, kind, view)
    search = replace(_SEARCH, kinds=[kind], render=scene.shown(poses.camera1_from, kind))
    as_it_is = search_orbit(scene, poses, search, view, draw)  # first, so that what it draws is there
    if 1 - as_it_is.cost > max(found.similarity + _BETTER, _FITS * found.in_view_1):
        turned = rotation_angle(as_it_is.poses.camera_from_camera1[view, :3, :3])
        return replace(found, found_deg=math.degrees(turned))

    def similarity(way: str) -> float:
        return 1 - search_orbit(_changed(scene, kind, view, _CHANGES[way]), poses, search, view, draw).cost

    seen = on_all_cores(similarity, ways, scene.device)
    best = max(range(len(ways)), key=lambda n: seen[n])
    if seen[best] > 1 - as_it_is.cost + _BETTER:
        return replace(found, as_stored=ways[best])
    return found


def _explained_at_known_view(scene: Scene, poses: Poses, found: Misfit, imaging: Imaging) -> Misfit:
    """An image whose view the other one places: does it show another view, or was it stored otherwise?"""
    kind, view = found.kind, found.view
    others = [other for other in range(scene.views) if other != view]
    swapped = replace(scene, images=scene.images | {kind: (scene.images[kind][view],) * scene.views}, fields={})
    seen = _similarities(swapped, poses, [(kind, other) for other in others], imaging) if others else []
    reasons = [(similarity, replace(found, as_view=other)) for similarity, other in zip(seen, others, strict=True)]
    for way in _ways(scene, kind, view):
        (similarity,) = _similarities(_changed(scene, kind, view, _CHANGES[way]), poses, [(kind, view)], imaging)
        reasons.append((similarity, replace(found, as_stored=way)))
    best, reason = max(reasons, key=lambda each: each[0])
    return reason if best > max(found.similarity + _BETTER, _FITS * found.in_view_1) else found


def _ways(scene: Scene, kind: Kind, view: int) -> list[str]:
    """What may have been done to an image when it was stored."""
    height, width = scene.image(kind, view).shape
    return [way for way in _CHANGES if height == width or not way.endswith(("90°", "270°"))]


def _drawn_once() -> Draw:
    """`drawn_from` that keeps what it has drawn: the same poses are compared with an image in many ways."""
    kept: dict[tuple[Kind, Camera, Level, bytes], Drawn] = {}

    def draw(scene: Scene, poses: Poses, search: OrbitSearch, image: tuple[Kind, int], cameras: Tensor) -> Drawn:
        kind, view = image
        camera = poses.camera(view, search.level.camera(scene.carm.camera))
        key = kind, camera, search.level, cameras.cpu().numpy().tobytes()
        if key not in kept:
            kept[key] = drawn_from(scene, poses, search, image, cameras)
        return kept[key]

    return draw


def _changed(scene: Scene, kind: Kind, view: int, change: Callable[[Tensor], Tensor]) -> Scene:
    """The scene with one of its images changed, and what is exposed of it."""

    def in_place(images: dict[Kind, tuple[Tensor | None, ...]]) -> dict[Kind, tuple[Tensor | None, ...]]:
        return {
            of: tuple(
                change(one) if of == kind and n == view and one is not None else one for n, one in enumerate(images[of])
            )
            for of in images
        }

    return replace(scene, images=in_place(scene.images), fields=in_place(scene.fields))


def _similarities(scene: Scene, poses: Poses, images: list[tuple[Kind, int]], imaging: Imaging) -> list[float]:
    """How well images, (kind, view) pairs, fit what is drawn for them."""
    names = list(poses.camera1_from)
    still = Body((names[0],), 0, reference_point_in_view(scene, poses, names[0], 0), torch.ones(6, dtype=torch.float64))
    costs = image_costs(scene, poses, (still,), names, images, _LEVEL, _SIMILARITY, imaging=imaging)
    return (1 - costs(costs.still[None])).flatten().tolist()
