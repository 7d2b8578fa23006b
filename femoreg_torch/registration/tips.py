"""Does a guide end in the images where its model ends?

A tip is a small part of a device. If it is some mm longer than its model, all else of the device still lies where it
is, and hardly any similarity over the whole images is lost. But the tip is what is steered. So the last 14 mm of the
model are stretched and compressed along the guide, and the images near the tip tell which length they show.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.cores import on_all_cores
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Poses, project_points, transform_points
from femoreg_torch.optimize import parabola_minimum
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.objective import ImageCosts, image_costs
from femoreg_torch.registration.scene import Body, Kind, RigidObject, Scene
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume

_LEVEL = Level(pixel_mm=1.55, step_mm=0.75)
_SIMILARITY = GradNcc(patch_radius=3)
_LONGEST_MM = 4  # by which the model is stretched or compressed, in steps of 1 mm
_STRETCH_MM = 6.0, 14.0  # before the tip: where the model is stretched; nearer to the tip it keeps its shape
_AROUND_MM = 12.0  # of the end of the guide: the box that is stretched, and, at the depth of the tip, what is looked at
_MARGIN_PX = 8  # of the level, around what is looked at: what the patches and derivatives there need
_LEAST_PIXELS = 200  # of an image, near the tip, for it to count


@dataclass(frozen=True)
class TipLength:
    """How the end of a guide lies in the images."""

    longer_mm: float  # than its model
    gain: float  # of the mean patch Grad-NCC near the tip, by a model of that length


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
    near = _near_the_tip(scene, poses, name, kind, tip, axis)
    views = [view for view, mask in enumerate(near) if mask is not None and mask.sum() >= _LEAST_PIXELS]
    if not views:
        return None
    thing = scene.objects[name]
    parted = _parted(thing.volume, tip, axis)
    if parted is None:
        return None
    rest, end = parted
    names = f"{name}, without its tip", f"{name}, its tip"
    objects = [
        RigidObject(part, thing.reference_point, thing.shown_in, sharp=thing.sharp, hardening=thing.hardening)
        for part in (rest, end)
    ]
    shown = [other for other in scene.shown(poses.camera1_from, kind) if other != name]
    for each in names:
        poses = poses.with_object(each, poses.camera1_from[name])
    scene = replace(
        scene,
        objects=scene.objects | dict(zip(names, objects, strict=True)),
        fields=scene.fields | {kind: tuple(near)},
    )
    still = Body((names[1],), 0, tip, torch.ones(6, dtype=torch.float64))

    def costs_of(view: int) -> ImageCosts:
        window, image = _around(scene, kind, view), [(kind, view)]
        return image_costs(window, poses, (still,), [*shown, *names], image, _LEVEL, _SIMILARITY, imaging=imaging)

    try:
        costs = on_all_cores(costs_of, views, scene.device)
    except InputError:  # what is exposed leaves nothing to compare
        return None
    lengths = range(-_LONGEST_MM, _LONGEST_MM + 1)
    stretched = _stretching(costs[0].objects[names[1]].volume, tip, axis)

    def cost(mm: float) -> float:
        candidates = [of.with_object(names[1], replace(objects[1], volume=stretched(mm))) for of in costs]
        return float(torch.cat([of(of.still[None]) for of in candidates]).mean())

    found = on_all_cores(cost, lengths, scene.device)
    best = min(max(min(range(len(found)), key=lambda n: found[n]), 1), len(found) - 2)
    aside = parabola_minimum(*found[best - 1 : best + 2])
    between = 0.0 if math.isnan(aside) else min(max(aside, -1.0), 1.0)
    return TipLength(lengths[best] + between, found[_LONGEST_MM] - min(found))


def _near_the_tip(scene: Scene, poses: Poses, name: str, kind: Kind, tip: Tensor, axis: Tensor) -> list[Tensor | None]:
    """The exposed pixels (H, W), bool, of the images of a kind around the end of a guide; None where there is none."""
    near: list[Tensor | None] = []
    for view in range(scene.views):
        if not scene.there([kind], [view]):
            near.append(None)
            continue
        image, camera, pose = scene.image(kind, view), scene.camera(poses, view), poses.camera_from(name)[view]
        ends = transform_points(pose, torch.stack([tip - _STRETCH_MM[0] * axis, tip + _LONGEST_MM * axis]))
        (u0, v0), (u1, v1) = project_points(camera, ends).tolist()
        radius = _AROUND_MM * camera.sdd_mm / float(ends[1, 2]) / camera.mean_pixel_mm
        rows, columns = (torch.arange(n, device=image.device) for n in image.shape)
        run_u, run_v = u1 - u0, v1 - v0
        x, y = columns[None] - u0, rows[:, None] - v0
        along = ((x * run_u + y * run_v) / max(run_u**2 + run_v**2, 1e-9)).clamp(0, 1)
        mask = (x - along * run_u) ** 2 + (y - along * run_v) ** 2 <= radius**2
        exposed = scene.field(kind, view)
        near.append(mask if exposed is None else mask & exposed)
    return near


def _around(scene: Scene, kind: Kind, view: int) -> Scene:
    """The scene of one view with images of what is exposed of the image of a kind, and a little around."""
    exposed = scene.field(kind, view)
    assert exposed is not None  # what is near the tip
    factor = binning(_LEVEL.pixel_mm, scene.carm.camera)
    seen = [exposed.any(1 - axis).nonzero()[:, 0] for axis in range(2)]
    first = [max(int(of[0]) // factor - _MARGIN_PX, 0) * factor for of in seen]
    last = [(int(of[-1]) // factor + 1 + _MARGIN_PX) * factor for of in seen]
    window = slice(first[0], last[0]), slice(first[1], last[1])

    def cut(images: dict[Kind, tuple[Tensor | None, ...]]) -> dict[Kind, tuple[Tensor | None, ...]]:
        return {
            kind: tuple(one[window] if n == view and one is not None else None for n, one in enumerate(of))
            for kind, of in images.items()
        }

    carm = replace(scene.carm, camera=scene.carm.camera.window(*window))
    return replace(scene, carm=carm, images=cut(scene.images), fields=cut(scene.fields), saturated={})


def _parted(volume: Volume, tip: Tensor, axis: Tensor) -> tuple[Volume, Volume] | None:
    """All but a box around the end of a guide; and that box, with room for the guide to grow, on a grid of its own.

    None if the box lies beside the volume.
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
    rest = volume.data.clone()
    rest[z, y, x] = 0
    around = [int(n) for pair in zip(inside_first - first, last + 1 - inside_last, strict=True) for n in pair]
    affine = volume.lps_from_index.clone()
    affine[:3, 3] += affine[:3, :3] @ first.double()
    return volume.with_data(rest), Volume(F.pad(volume.data[z, y, x], around), affine)


def _stretching(volume: Volume, tip: Tensor, axis: Tensor) -> Callable[[float], Volume]:
    """A volume whose end along an axis is stretched by so many mm; compressed where they are negative."""
    data = volume.data
    size = torch.tensor(data.shape).flip(0)
    x, y, z = (torch.arange(n, dtype=torch.float64) for n in size.tolist())
    rates = volume.lps_from_index[:3, :3].T @ axis
    height = z[:, None, None] * rates[2] + y[:, None] * rates[1] + x * rates[0]
    height += (volume.lps_from_index[:3, 3] - tip) @ axis
    near, far = _STRETCH_MM
    height = (height + far).to(data)
    along = torch.linalg.solve(volume.lps_from_index[:3, :3], axis)  # voxels per mm
    shift = (2 * along / (size - 1)).to(data)
    places = torch.meshgrid(*(2 * n / (len(n) - 1) - 1 for n in (z, y, x)), indexing="ij")
    here = torch.stack(places[::-1], -1).to(data)

    def stretched(mm: float) -> Volume:
        moved = mm * (height / (far - near + mm)).clamp(0, 1)  # of what lands at that height
        source = here - moved[..., None] * shift
        return volume.with_data(F.grid_sample(data[None, None], source[None], align_corners=True)[0, 0])

    return stretched
