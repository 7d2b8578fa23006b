"""Does a guide end in the images where its model ends?

A tip is a small part of a device. If it is some mm longer than its model, all else of the device still lies where it
is, and hardly any similarity over the whole images is lost. But the tip is what is steered. So the last 14 mm of the
model are stretched and compressed along the guide, and the images near the tip tell which length they show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses, project_points, transform_points
from femoreg_torch.optimize import parabola_minimum
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.scene import Body, Kind, Scene
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVEL = Level(pixel_mm=1.55, step_mm=0.75)
_SIMILARITY = GradNcc(patch_radius=3)
_LONGEST_MM = 4  # by which the model is stretched or compressed, in steps of 1 mm
_STRETCH_MM = 6.0, 14.0  # before the tip: where the model is stretched; nearer to the tip it keeps its shape
_AROUND_MM = 12.0  # of the end of the guide: the box that is stretched, and, at the depth of the tip, what is looked at
_LEAST_PIXELS = 200  # of an image, near the tip, for it to count
_MARGIN_PX = 8  # of `_LEVEL`, around what is looked at: pixels that what is seen there is made of
_GRID_PX = 2  # of `_LEVEL`: where a window may begin; soft tissue is drawn on pixels so much larger, and interpolated


@dataclass(frozen=True)
class TipLength:
    """How the end of a guide lies in the images."""

    longer_mm: float  # than its model
    gain: float  # of the mean patch Grad-NCC near the tip, by a model of that length
    cost: float  # 1 − that similarity
    least_gain: float  # in any view


def tip_length(
    scene: Scene, poses: Poses, name: str, kind: Kind, guide: tuple[Tensor, Tensor], imaging: Imaging
) -> TipLength | None:
    """How much longer than its model the images of a kind show a device, at its pose.

    Its guide runs from one point (3,) mm to the tip, both in its own space.

    None where the images of that kind do not show the place of the tip, what is saturated hides it, or the model has
    nothing there.
    """
    base, tip = (point.double() for point in guide)
    axis = (tip - base) / (tip - base).norm()
    windows = {view: _near_the_tip(scene, poses, name, kind, view, tip, axis) for view in range(scene.views)}
    near = {view: window for view, window in windows.items() if window is not None}
    if not near:
        return None
    thing = scene.objects[name]
    parted = _parted(thing.volume, tip, axis)
    if parted is None:
        return None
    names = f"{name}, without its tip", f"{name}, its tip"
    # Each starts as the whole does: one that landmarks seem to place would be the scene's anchor.
    rest, end = (replace(thing, volume=part, unsure=()) for part in parted)
    shown = [other for other in scene.shown(poses.camera1_from, kind) if other != name]
    for each in names:
        poses = poses.with_object(each, poses.camera1_from[name])
    # What these images do not show stays too: the soft tissue may lie in its space.
    others = {other: scene.objects[other] for other in scene.objects if other != name}
    objects = others | dict(zip(names, (rest, end), strict=True))
    still = Body((names[1],), 0, tip, torch.ones(6, dtype=torch.float64))

    def costs_of(view: int, window: Scene) -> ImageCosts:
        window = replace(window, objects=objects)
        render = [*shown, *names]
        return image_costs(window, poses, (still,), render, [(kind, view)], _LEVEL, _SIMILARITY, imaging=imaging)

    try:
        costs = [costs_of(view, window) for view, window in near.items()]
    except InputError:  # what is exposed leaves nothing to compare
        return None
    lengths = range(-_LONGEST_MM, _LONGEST_MM + 1)
    drawn = costs[0].objects[names[1]].volume

    def of_each(mm: float) -> list[float]:
        stretched = replace(end, volume=_stretched(drawn, tip, axis, mm))
        return [float(of.with_object(names[1], stretched)(of.still[None])) for of in costs]

    by_view = on_all_cores(of_each, lengths, scene.device)
    found = [sum(each) / len(costs) for each in by_view]
    best = min(max(min(range(len(found)), key=lambda n: found[n]), 1), len(found) - 2)
    aside = parabola_minimum(*found[best - 1 : best + 2])
    between = 0.0 if math.isnan(aside) else min(max(aside, -1.0), 1.0)
    gains = [as_is - then for as_is, then in zip(by_view[_LONGEST_MM], by_view[found.index(min(found))], strict=True)]
    return TipLength(lengths[best] + between, found[_LONGEST_MM] - min(found), min(found), min(gains))


def _near_the_tip(
    scene: Scene, poses: Poses, name: str, kind: Kind, view: int, tip: Tensor, axis: Tensor
) -> Scene | None:
    """The scene through a window around the end of a guide, in pixels of `_LEVEL`: it has the images of one view alone.

    In that of `kind` only what lies near the tip is exposed. None where too little of it is.
    """
    if not scene.there([kind], [view]):
        return None
    camera, pose = scene.camera(poses, view), poses.camera_from(name)[view]
    ends = transform_points(pose, torch.stack([tip - _STRETCH_MM[0] * axis, tip + _LONGEST_MM * axis]))
    pixels = project_points(camera, ends)
    if not bool(pixels.isfinite().all()):  # behind the source
        return None
    radius = _AROUND_MM * camera.sdd_mm / float(ends[1, 2]) / camera.mean_pixel_mm
    coarse = _LEVEL.camera(scene.carm.camera)
    factor = binning(_LEVEL.pixel_mm, scene.carm.camera)
    first = ((pixels.amin(0) - radius) / factor).floor().long() - _MARGIN_PX
    last = ((pixels.amax(0) + radius) / factor).ceil().long() + _MARGIN_PX
    columns, rows = (
        slice(max(0, int(a)) // _GRID_PX * _GRID_PX, min(size, int(b)))
        for a, b, size in zip(first, last, coarse.shape[::-1], strict=True)
    )
    if rows.stop <= rows.start or columns.stop <= columns.start:
        return None
    inside = slice(rows.start * factor, rows.stop * factor), slice(columns.start * factor, columns.stop * factor)
    exposed = scene.field(kind, view)
    mask = _around(pixels.tolist(), radius, *inside).to(scene.device)
    if exposed is not None:
        mask &= exposed[inside]
    if mask.sum() < _LEAST_PIXELS:
        return None
    first_field = scene.field(scene.first_kind, view)
    fields = {scene.first_kind: None if first_field is None else first_field[inside], kind: mask}

    def of_this_view(there: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(there if one == view else None for one in range(scene.views))

    return replace(
        scene,
        carm=replace(scene.carm, camera=coarse.window(rows, columns)),
        images={
            of: of_this_view(_LEVEL.image(scene.image(of, view), scene.carm.camera)[rows, columns].contiguous())
            for of, _ in scene.there(dict.fromkeys((scene.first_kind, kind)), [view])
        },
        fields={
            of: of_this_view(None if field is None else _LEVEL.field(field, scene.carm.camera))
            for of, field in fields.items()
        },
    )


def _around(ends: Sequence[tuple[float, float]], radius: float, rows: slice, columns: slice) -> Tensor:
    """The pixels (H, W), bool, of a window that are no farther than a radius from the line between two of them."""
    (u0, v0), (u1, v1) = ends
    run_u, run_v = u1 - u0, v1 - v0
    y, x = (torch.arange(part.start, part.stop) for part in (rows, columns))
    x, y = x[None] - u0, y[:, None] - v0
    along = ((x * run_u + y * run_v) / max(run_u**2 + run_v**2, 1e-9)).clamp(0, 1)
    return (x - along * run_u) ** 2 + (y - along * run_v) ** 2 <= radius**2


def _parted(volume: Volume, tip: Tensor, axis: Tensor) -> tuple[Volume, Volume] | None:
    """All but a box around the end of a guide; and what is in it, with room for the guide to grow, on its own grid.

    None if nothing is in it.
    """
    inverse, size = torch.linalg.inv(volume.lps_from_index), torch.tensor(volume.data.shape).flip(0)
    ends = torch.stack([tip - _STRETCH_MM[1] * axis, tip + _LONGEST_MM * axis])
    low, high = ends.amin(0) - _AROUND_MM, ends.amax(0) + _AROUND_MM
    corners = transform_points(inverse, torch.cartesian_prod(*torch.stack([low, high]).T))
    first, last = corners.amin(0).floor().long(), corners.amax(0).ceil().long()
    inside_first, inside_last = first.clamp_min(0).minimum(size), (last + 1).clamp_min(0).minimum(size)
    if not bool((inside_first < inside_last).all()):
        return None
    x, y, z = (slice(int(a), int(b)) for a, b in zip(inside_first, inside_last, strict=True))
    filled = volume.data[z, y, x].nonzero().flip(1).cpu()
    if not len(filled):
        return None
    grown = _LONGEST_MM * inverse[:3, :3] @ axis
    first = first.maximum(inside_first + filled.amin(0) + grown.clamp_max(0).floor().long() - 1)
    last = last.minimum(inside_first + filled.amax(0) + grown.clamp_min(0).ceil().long() + 1)
    rest = volume.data.clone()
    rest[z, y, x] = 0
    around = [int(n) for pair in zip(inside_first - first, last + 1 - inside_last, strict=True) for n in pair]
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3] @ first.double()
    return volume.with_data(rest), Volume(F.pad(volume.data[z, y, x], around), affine)


def _stretched(volume: Volume, tip: Tensor, axis: Tensor, mm: float) -> Volume:
    """A volume whose end along an axis is stretched by so much; compressed where it is negative."""
    data = volume.data
    size = torch.tensor(data.shape).flip(0)
    x, y, z = (torch.arange(n, dtype=torch.float64) for n in size.tolist())
    rates = volume.lps_from_index[:3, :3].T @ axis
    height = z[:, None, None] * rates[2] + y[:, None] * rates[1] + x * rates[0]
    height += (volume.lps_from_index[:3, 3] - tip) @ axis
    near, far = _STRETCH_MM
    moved = mm * ((height + far) / (far - near + mm)).clamp(0, 1)  # of what lands at that height
    along = torch.linalg.solve(volume.lps_from_index[:3, :3], axis)  # voxels per mm
    planes = torch.meshgrid(z, y, x, indexing="ij")[::-1]
    source = torch.stack([2 * (n - moved * a) / (m - 1) - 1 for n, a, m in zip(planes, along, size, strict=True)], -1)
    return volume.with_data(F.grid_sample(data[None, None], source[None].to(data), align_corners=True)[0, 0])
