"""What a device is made of: blocks of it fitted to its shadows, grouped into few materials, and these fitted together.

The device's pose is estimated with its materials, as a wrong pose looks like a wrong material, and the other way round.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.drr import CPU, project
from femoreg_torch.geometry import Poses, about_point, exp_se3, transform_points
from femoreg_torch.registration.materials.regions import (
    Borders,
    Doubles,
    blocks_of,
    materials,
    mistakes,
    touching_faces,
)
from femoreg_torch.registration.materials.shadows import (
    LEAST_PIXELS,
    LEVEL,
    TURN,
    TWIST,
    Device,
    View,
    device_of,
    first_guess,
    hardening_of,
    pairs_of,
    residuals,
    scatter_of,
    solve,
    views_of,
)
from femoreg_torch.registration.scene import Kind, RigidObject, Scene
from femoreg_torch.volume import Volume

_START_ATTENUATION = 0.2  # 1/mm: titanium at 80 keV
_FEWEST_ROUNDS, _MOST_ROUNDS = 2, 12  # for blocks, and again for materials; most are still after three or four
_STILL = np.array([0.25] * 3 + [0.15] * 3)  # units of the pose: a round that moves it less is the last
_ITERATIONS, _FEWER = 200, 40  # of L-BFGS from nothing, and from the round before
_AS_NAMED = 0.3  # logarithm: one material so near to what the case names is that
_DARK = 0.3  # of the light: darker pixels tell the scattered light
_LEAST_SCATTER, _MOST_SCATTER = 0.02, 1.0  # per primary light


@dataclass(frozen=True, eq=False)
class DeviceFit:
    """A device as the images see it."""

    volume: Volume  # attenuation, 1/mm
    camera1_from: Tensor  # (4, 4)
    attenuations: tuple[float, ...]  # 1/mm, of its materials
    scatter: float | None  # per primary light but for the bones; None where no shadow is dark enough
    misfit: float  # median difference of the logarithms of intensity
    evaluations: int
    unsure: tuple[Volume, ...]  # see `RigidObject`: blocks at the borders of materials, taken for the wrong one
    hardening: float  # of the beam, see `imaging.hardened`
    as_told: bool  # whether its materials were named, and the images agree


def fit_device(scene: Scene, poses: Poses, name: str, kind: Kind) -> DeviceFit | None:
    """Attenuation and pose of a device from images without it and those of `kind` with it; None if none shows it."""
    thing = scene.objects[name].to(CPU)
    share = thing.volume.with_data(_share(thing))
    pairs, borders = pairs_of(scene, kind), None
    if thing.materials_known and len(thing.parts) > 1:
        owner, attenuation = _told(thing.parts)
        device = device_of(name, kind, share, owner, len(attenuation), told=attenuation, sharp=thing.sharp)
        seen = views_of(scene, poses, device, pairs)
        if not seen:
            return None
        fit, evaluations = first_guess(seen, attenuation), 0
    else:
        blocks, count = blocks_of(share)
        touching = touching_faces(blocks)
        device = device_of(name, kind, share, blocks, count, touching)
        seen = views_of(scene, poses, device, pairs)
        if not seen:
            return None
        fit, evaluations = solve(seen, device, first_guess(seen, np.full(count, _START_ATTENUATION)), _ITERATIONS)
        poses, fit, seen, used = _settled(scene, poses, device, fit, seen)
        material, attenuation = materials(fit[:count], np.bincount(blocks[blocks >= 0].numpy(), minlength=count))
        fit = np.concatenate([attenuation, fit[count:]])
        borders = Borders(blocks, material, touching) if len(attenuation) > 1 else None
        owner = torch.from_numpy(np.append(material, -1))[blocks]
        device = device_of(name, kind, share, owner, len(attenuation), sharp=thing.sharp)
        evaluations += used
    poses, fit, seen, used = _settled(scene, poses, device, fit, seen)
    attenuation = fit[: device.regions]
    misfit = np.concatenate([np.abs(residuals(fit, seen, n, device.regions)[0]) for n in range(len(seen))])
    named = float(thing.volume.data.max())  # of a single solid
    as_named = device.regions == 1 and abs(math.log(max(attenuation[0], 1e-6) / named)) < _AS_NAMED
    return DeviceFit(
        scene.objects[name].volume if as_named else device.filled(attenuation),
        poses.camera1_from[name],
        tuple(attenuation.tolist()),
        _scatter_ratio(scene, poses, seen, fit, device.regions),
        float(np.median(misfit)),
        evaluations + used,
        () if borders is None else mistakes(share, borders, attenuation),
        hardening_of(fit),
        thing.materials_known and (as_named or len(thing.parts) > 1),
    )


def _scatter_ratio(scene: Scene, poses: Poses, seen: list["View"], fit: Doubles, regions: int) -> float | None:
    """Scattered light per primary light behind all but what is drawn without the device.

    The median of pixels behind enough metal, and of views; None if no view has enough such pixels.
    """
    found = []
    for n, view in enumerate(seen):
        dark = (view.paths @ fit[:regions] > -math.log(_DARK)) & ~view.white
        if dark.sum() < LEAST_PIXELS:
            continue
        camera = poses.camera(view.pair.view, LEVEL.camera(scene.carm.camera))
        drawn = np.zeros(len(view.pixels))
        if names := scene.shown(poses.camera1_from, scene.first_kind):
            placed = torch.stack([poses.camera_from(name)[view.pair.view] for name in names])[None]
            bones = project([scene.objects[name].volume.to(CPU) for name in names], placed, camera, LEVEL.step_mm)
            drawn = bones.flatten().double().numpy()[view.pixels]
        scattered = view.corners @ fit[scatter_of(n, regions)]
        primary = np.maximum(view.without - scattered, 1e-3 * view.without) * np.exp(drawn)
        found.append(np.median((scattered / primary)[dark]))
    return min(max(float(np.median(found)), _LEAST_SCATTER), _MOST_SCATTER) if found else None


def _settled(
    scene: Scene, poses: Poses, device: Device, fit: Doubles, seen: list["View"]
) -> tuple[Poses, Doubles, list["View"], int]:
    """Poses and parameters after attenuation and pose have been fitted together a few times; views, and evaluations.

    How the images change as the device moves is linear in each of them, and taken anew in the next.
    """
    evaluations = 0
    for number in range(1, _MOST_ROUNDS + 1):
        volume = device.filled(fit[: device.regions])
        seen = views_of(scene, poses, device, [view.pair for view in seen], volume)
        fit, used = solve(seen, device, fit, _FEWER)
        evaluations += used
        still = (np.abs(fit[TURN]) < _STILL).all()
        pose = poses.camera1_from[device.name]
        centre = transform_points(pose, scene.objects[device.name].reference_point[None])[0]
        motion = about_point(exp_se3(torch.from_numpy(fit[TURN] * TWIST)[None]), centre)[0]
        poses = poses.with_object(device.name, motion @ pose)
        fit[TURN] = 0
        if still and number >= _FEWEST_ROUNDS:
            break
    return poses, fit, seen, evaluations


def _share(thing: RigidObject) -> Tensor:
    """The share of every voxel that is inside the device; of a device scanned in HU, its attenuation per the most."""
    if len(thing.parts) > 1:
        return torch.stack([part.data / part.data.max() for part in thing.parts]).sum(0)
    return thing.volume.data / thing.volume.data.max()


def _told(parts: Sequence[Volume]) -> tuple[Tensor, Doubles]:
    """The part that most of every voxel belongs to, −1 where it is empty, and the attenuations that the case names."""
    highest = [float(part.data.max()) for part in parts]
    shares = torch.stack([part.data / most for part, most in zip(parts, highest, strict=True)])
    most, owner = shares.max(0)
    return torch.where(most > 0, owner, -1), np.array(highest)
