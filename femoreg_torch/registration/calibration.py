"""What nobody tells about the images is estimated from them: what a device is made of, and scattered light.

Images without and with a device are taken from one C-arm pose, so that all but the device is the same in both. Let Iₐ
and I_d be their intensities and S the light that is scattered into a pixel; then

    I_d = g · ((Iₐ − S) · (1 + h Σ a ℓ)^(−1/h) + S)

with the path ℓ through each region of the device, its attenuation a where it is thin, a factor g between the exposures,
and the hardening h of the beam in it (`registration.imaging.hardened`). The additive scatter is that of Seibert and
Boone, X-ray scatter removal by deconvolution, Med Phys 15 (1988) 567. Where metal is opaque the shadow is S, whatever
the metal, so that its darkest places tell S, and lighter ones the attenuation. The device's pose is estimated with all
that, as a wrong pose looks like a wrong material, and the other way round. This least squares is sparse and runs on the
CPU, with SciPy, wherever the scene lies.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.sparse import csr_array
from torch import Tensor

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.cores import on_all_cores
from femoreg_torch.drr import CPU, project, project_with_jacobian
from femoreg_torch.geometry import (
    Camera,
    Poses,
    about_point,
    exp_se3,
    pose_difference,
    transform_points,
)
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.regions import (
    Borders,
    Doubles,
    Indices,
    RegionVoxels,
    blocks_of,
    materials,
    mistakes,
    region_paths,
    region_voxels,
    touching_faces,
)
from femoreg_torch.registration.scene import Kind, RigidObject, Scene
from femoreg_torch.registration.weights import dilated
from femoreg_torch.volume import Volume

_LEVEL = Level(pixel_mm=1.55, step_mm=0.5)
_LEAST_PATH_MM = 0.3  # of a ray through the device, for its pixel to count
_LEAST_PIXELS = 100  # of a view that counts
_AROUND_MM = 3.0  # on the detector: pixels beyond the shadow that count, so that the device may move
_START_ATTENUATION = 0.2  # 1/mm: titanium at 80 keV
_FAINTEST = 1e-3  # 1/mm
_MOST_ATTENUATION = 2.5  # 1/mm: steel at 45 keV, of which 2 mm are opaque
_VARIATION = 5.0  # weight of a step of 1/mm between all blocks
_FLAT = 0.01  # 1/mm: steps that are none
_TOLD_WITHIN = 0.3  # deviation of the logarithm of what a named material attenuates; nobody tells the tube's voltage
_TOLD_WEIGHT = 1 / 200  # of one named material beside all pixels, whose misfits are alike over wide regions
_MISFIT = 0.05  # of a logarithm of intensity; larger ones (something else has changed) count less
_FEWEST_ROUNDS, _MOST_ROUNDS = 2, 4  # for blocks, and again for materials
_STILL = np.array([0.25] * 3 + [0.15] * 3)  # units of the pose: a round that moves it less is the last
_ITERATIONS, _FEWER = 200, 40  # of L-BFGS from nothing, and from the round before
_TWIST = np.array([0.01] * 3 + [1.0] * 3)  # rad and mm: one unit of the pose
_MOST_DEG, _MOST_MM = 8.0, 12.0  # that the device may move; more means that the images do not show it as it is
_AS_NAMED = 0.3  # logarithm: one material so near to what the case names is that
# Squared coefficient of variation of metal's attenuation over the spectrum of a tube at 75 kV, behind 200 mm of water:
# 0.35, by the tables of `volume.materials`, 0.22 at 60 kV and 0.5 at 100 kV. Thick metal, which lets the hardest light
# through, hardens the beam by less than the law of `hardened` says: 5 mm of steel as if it were 0.1. Between the two.
_HARDENING = 0.2
_DARK = 0.3  # of the light: darker pixels tell the scattered light
_LEAST_SCATTER, _MOST_SCATTER = 0.02, 1.0  # per primary light
_LEAST_PASSING = 1e-3  # of 1 + h Σ a ℓ, where a motion of the device takes its path below nothing
_CORNERS = 4  # of the box around the device: scattered light is interpolated between them


@dataclass(frozen=True)
class Calibration:
    """A step that estimates what a device attenuates, together with its pose and the scatter in its shadow."""

    name: str

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`."""
        if not devices(scene, poses):
            return "no device is shown by one kind of images and missing in the first kind"
        return None

    def calibrate(self, scene: Scene, poses: Poses) -> tuple[Scene, StageRecord]:
        """The scene with the device as the images show it, and a record with the poses, that of the device improved."""
        began = time.perf_counter()
        moving, cost, evaluations = [], 0.0, 0
        told = []
        for name, kind in devices(scene, poses):
            fit = fit_device(scene, poses, name, kind)
            if fit is None:
                told.append(f"{name} not estimated, as no view shows enough of it")
                continue
            thing = scene.objects[name]
            deg, mm = pose_difference(poses.camera1_from[name], fit.camera1_from, thing.reference_point)
            if deg > _MOST_DEG or mm > _MOST_MM:
                told.append(f"{name} not estimated, as it would have moved by {deg:.0f}° and {mm:.0f} mm")
                continue
            unsure = tuple(difference.to(scene.device) for difference in fit.unsure)
            found = replace(thing, volume=fit.volume.to(scene.device), hardening=_HARDENING, unsure=unsure)
            objects = scene.objects | {name: found}
            scene = replace(scene, objects=objects, scatter=scene.scatter or fit.scatter)
            poses = poses.with_object(name, fit.camera1_from)
            moving.append(name)
            told.append(f"{name}: {', '.join(f'{a:.2f}' for a in fit.attenuations)}/mm")
            if fit.scatter is not None:
                told.append(f"scattered light {fit.scatter:.2f} of the primary")
            cost, evaluations = fit.misfit, evaluations + fit.evaluations
        seconds = time.perf_counter() - began
        return scene, StageRecord(
            self.name,
            None,
            cost,
            evaluations,
            seconds,
            "attenuation of the " + "; ".join(told),
            poses,
            moving=tuple(moving),
        )


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


def devices(scene: Scene, poses: Poses) -> list[tuple[str, Kind]]:
    """Objects that are all that one kind of images has more than the first, with that kind."""
    found = []
    for kind in list(scene.images)[1:]:
        new = [n for n in scene.shown(poses.camera1_from, kind) if scene.first_kind not in scene.objects[n].shown_in]
        if len(new) == 1 and scene.there([kind], range(scene.views)):
            found.append((new[0], kind))
    return found


def fit_device(scene: Scene, poses: Poses, name: str, kind: Kind) -> DeviceFit | None:
    """Attenuation and pose of a device from images without it and those of `kind` with it; None if none shows it."""
    thing = scene.objects[name].to(CPU)
    share = thing.volume.with_data(_share(thing))
    borders = None
    if thing.materials_known and len(thing.parts) > 1:
        owner, attenuation = _told(thing.parts)
        device = _device(name, kind, share, owner, len(attenuation), told=attenuation)
        seen = _views(scene, poses, device)
        if not seen:
            return None
        fit, evaluations = _begin(seen, attenuation), 0
    else:
        blocks, count = blocks_of(share)
        touching = touching_faces(blocks)
        device = _device(name, kind, share, blocks, count, touching)
        seen = _views(scene, poses, device)
        if not seen:
            return None
        fit, evaluations = _solve(seen, device, _begin(seen, np.full(count, _START_ATTENUATION)), _ITERATIONS)
        poses, fit, seen, used = _settled(scene, poses, device, fit, seen)
        material, attenuation = materials(fit[:count], np.bincount(blocks[blocks >= 0].numpy(), minlength=count))
        fit = np.concatenate([attenuation, fit[count:]])
        borders = Borders(blocks, material, touching) if len(attenuation) > 1 else None
        device = _device(name, kind, share, torch.from_numpy(np.append(material, -1))[blocks], len(attenuation))
        evaluations += used
    poses, fit, seen, used = _settled(scene, poses, device, fit, seen)
    attenuation = fit[: device.regions]
    misfit = np.concatenate([np.abs(_residual(fit, seen, n, device.regions)[0]) for n in range(len(seen))])
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
    )


def _scatter_ratio(scene: Scene, poses: Poses, seen: list["_View"], fit: Doubles, regions: int) -> float | None:
    """Scattered light per primary light behind all but what is drawn without the device.

    The median of pixels behind enough metal, and of views; None if no view has enough such pixels.
    """
    found = []
    for n, view in enumerate(seen):
        dark = view.paths @ fit[:regions] > -math.log(_DARK)
        if dark.sum() < _LEAST_PIXELS:
            continue
        camera = poses.camera(view.view, _LEVEL.camera(scene.carm.camera))
        names = scene.shown(poses.camera1_from, scene.first_kind)
        placed = torch.stack([poses.camera_from(name)[view.view] for name in names])[None]
        bones = project([scene.objects[name].volume.to(CPU) for name in names], placed, camera, _LEVEL.step_mm)
        drawn = bones.flatten().double().numpy()[view.pixels]
        scattered = view.corners @ fit[_scatter_of(n, regions)]
        primary = np.maximum(view.without - scattered, 1e-3 * view.without) * np.exp(drawn)
        found.append(np.median((scattered / primary)[dark]))
    return min(max(float(np.median(found)), _LEAST_SCATTER), _MOST_SCATTER) if found else None


@dataclass(frozen=True, eq=False)
class _Device:
    """A device in regions, each of one attenuation."""

    name: str
    kind: Kind  # of the images that show it
    share: Volume  # of every voxel that is inside
    owner: Tensor  # (Z, Y, X): the region of every voxel, −1 where it is empty
    regions: int
    voxels: RegionVoxels
    touching: Indices | None  # (n, 3): pairs of regions, and the faces between them
    told: Doubles | None  # (regions,) attenuations that the case names

    def filled(self, attenuation: Doubles) -> Volume:
        """Its attenuation, 1/mm, from that of its regions."""
        of_voxel = torch.from_numpy(np.append(attenuation, 0.0)).float()[self.owner]
        return self.share.with_data(self.share.data * of_voxel)


def _device(
    name: str,
    kind: Kind,
    share: Volume,
    owner: Tensor,
    regions: int,
    touching: Indices | None = None,
    told: Doubles | None = None,
) -> _Device:
    return _Device(name, kind, share, owner, regions, region_voxels(share, owner, regions), touching, told)


def _settled(
    scene: Scene, poses: Poses, device: _Device, fit: Doubles, seen: list["_View"]
) -> tuple[Poses, Doubles, list["_View"], int]:
    """Poses and parameters after attenuation and pose have been fitted together a few times; views, and evaluations.

    How the images change as the device moves is linear in each of them, and taken anew in the next.
    """
    evaluations = 0
    for number in range(1, _MOST_ROUNDS + 1):
        volume = device.filled(fit[: device.regions])
        seen = _views(scene, poses, device, [view.view for view in seen], volume)
        fit, used = _solve(seen, device, fit, _FEWER)
        evaluations += used
        still = (np.abs(fit[-6:]) < _STILL).all()
        pose = poses.camera1_from[device.name]
        centre = transform_points(pose, scene.objects[device.name].reference_point[None])[0]
        motion = about_point(exp_se3(torch.from_numpy(fit[-6:] * _TWIST)[None]), centre)[0]
        poses = poses.with_object(device.name, motion @ pose)
        fit[-6:] = 0
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


@dataclass(frozen=True, eq=False)
class _View:
    """The pixels of one view that the device covers, and those around."""

    view: int
    pixels: Indices  # (N,) of the image of `_LEVEL`
    paths: csr_array  # (N, K) mm through each region
    changes: Doubles  # (N, 6) of the path · attenuation by a twist, in units of `_TWIST`
    without: Doubles  # (N,) intensities
    with_it: Doubles
    corners: Doubles  # (N, 4): share of each corner of the box around the device


def _views(
    scene: Scene, poses: Poses, device: _Device, chosen_views: list[int] | None = None, volume: Volume | None = None
) -> list[_View]:
    """What views with both images show of a device, by default those that show enough of it.

    With its `volume` they tell how their image changes as the device moves.
    """

    def look(view: int) -> _View | None:
        camera = poses.camera(view, _LEVEL.camera(scene.carm.camera))
        pose = poses.camera_from(device.name)[view]
        paths = region_paths(device.voxels, pose, camera)
        covered = torch.from_numpy(paths.sum(1)).reshape(camera.shape) > _LEAST_PATH_MM
        if volume is not None:
            covered = dilated(covered, _AROUND_MM, camera)
        intensities = []
        for k in (scene.first_kind, device.kind):
            image = _LEVEL.image(scene.image(k, view), scene.carm.camera)
            intensities.append((-image.cpu()).exp().flatten().double().numpy())
            field = scene.field(k, view)
            if field is not None:
                covered &= _LEVEL.field(field, scene.carm.camera).cpu()
        chosen = np.flatnonzero(covered.flatten().numpy())
        changes = np.zeros((len(chosen), 6))
        if volume is not None:
            centre = transform_points(pose, scene.objects[device.name].reference_point[None])[0]
            _, jacobian = project_with_jacobian(volume, pose[None], camera, centre, _LEVEL.step_mm)
            turn = torch.block_diag(*[poses.camera_from_camera1[view][:3, :3]] * 2)  # twists of camera 1 to this one's
            changes = (jacobian[0].flatten(0, 1)[chosen].double() @ turn).numpy() * _TWIST
        if chosen_views is None and len(chosen) < _LEAST_PIXELS:
            return None
        without, with_it = (values[chosen] for values in intensities)
        return _View(view, chosen, paths[chosen], changes, without, with_it, _corners(chosen, camera))

    there = [view for _, view in scene.there([device.kind], range(scene.views))]
    asked = [view for view in there if chosen_views is None or view in chosen_views]
    return [view for view in on_all_cores(look, asked, scene.device) if view is not None]


def _begin(seen: list[_View], attenuation: Doubles) -> Doubles:
    """Parameters, see `_solve`, with these attenuations, and scatter that leaves the darkest pixels some light."""
    scatter = np.repeat([0.7 * _darkest(view) for view in seen], _CORNERS)
    return np.concatenate([attenuation, scatter, np.zeros(len(seen) + 6)])


def _darkest(view: _View) -> float:
    """Nearly the darkest intensity behind the device."""
    return float(np.quantile(view.with_it, 0.03)) if len(view.with_it) else 1.0


def _solve(seen: list[_View], device: _Device, begin: Doubles, iterations: int) -> tuple[Doubles, int]:
    """Attenuations (K), scattered light (4 V), log factors between the exposures (V), a twist (6); and evaluations.

    Least squares of the logarithms of intensity, robust, plus, over the faces between `touching` regions, the total
    variation of the attenuation, as a device is of few materials (Rudin, Osher, Fatemi, Physica D 60 (1992) 259), and
    how far the attenuations are from those that the case names.
    """
    views, regions, touching = len(seen), device.regions, device.touching
    darkest = np.repeat([_darkest(view) for view in seen], _CORNERS)
    unit = np.concatenate([np.ones(regions), darkest, np.ones(views + 6)])
    highest = np.concatenate([np.full(regions, _MOST_ATTENUATION), np.inf * darkest, np.full(views, 0.5), [3.0] * 6])
    lowest = np.concatenate([np.zeros(regions + len(darkest)), -highest[-views - 6 :]])
    count = max(1, sum(len(view.with_it) for view in seen))

    def cost(y: Doubles) -> tuple[float, Doubles]:
        x = y * unit
        value, slope = 0.0, np.zeros_like(x)
        for n, view in enumerate(seen):
            residual, by_path, by_scatter = _residual(x, seen, n, regions)
            root = np.sqrt(1 + (residual / _MISFIT) ** 2)
            value += (root - 1).sum() / count
            push = residual / root / (_MISFIT**2 * count)
            slope[:regions] += view.paths.T @ (push * by_path)
            slope[_scatter_of(n, regions)] += (push * by_scatter) @ view.corners
            slope[regions + _CORNERS * views + n] -= push.sum()
            slope[-6:] += (push * by_path) @ view.changes
        if touching is not None and len(touching):
            one, other, faces = touching.T
            step = x[one] - x[other]
            soft = np.sqrt(step**2 + _FLAT**2)
            share = _VARIATION * faces / faces.sum()
            value += (share * (soft - _FLAT)).sum()
            np.add.at(slope, one, share * step / soft)
            np.add.at(slope, other, -share * step / soft)
        if device.told is not None:
            off = np.log(np.maximum(x[:regions], _FAINTEST) / device.told) / _TOLD_WITHIN
            value += 0.5 * _TOLD_WEIGHT * (off**2).sum()
            slope[:regions] += _TOLD_WEIGHT * off / (_TOLD_WITHIN * np.maximum(x[:regions], _FAINTEST))
        return value, slope * unit

    bounds = list(zip(lowest / unit, highest / unit, strict=True))
    options = {"maxiter": iterations}
    found = minimize(cost, begin / unit, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x) * unit, int(found.nfev)


def _scatter_of(n: int, regions: int) -> slice:
    """Where the scattered light of view n stands among the parameters."""
    return slice(regions + _CORNERS * n, regions + _CORNERS * (n + 1))


def _corners(pixels: Indices, camera: Camera) -> Doubles:
    """Shares (N, 4) of the corners of the box around pixels, by bilinear interpolation."""
    if not len(pixels):
        return np.zeros((0, _CORNERS))
    rows, columns = np.divmod(pixels, camera.shape[1])
    u = (columns - columns.min()) / max(1, np.ptp(columns))
    v = (rows - rows.min()) / max(1, np.ptp(rows))
    return np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)


def _residual(x: Doubles, seen: list[_View], n: int, regions: int) -> tuple[Doubles, Doubles, Doubles]:
    """Differences of the logarithms of intensity (N,) of view n, and their derivatives by Σ a ℓ and by S."""
    view = seen[n]
    gain = x[regions + _CORNERS * len(seen) + n]
    scatter = view.corners @ x[_scatter_of(n, regions)]
    integrals = view.paths @ x[:regions] + view.changes @ x[-6:]
    passing = np.maximum(1 + _HARDENING * integrals, _LEAST_PASSING)
    light = passing ** (-1 / _HARDENING)
    primary = np.maximum(view.without - scatter, 1e-3 * view.without)
    total = primary * light + scatter
    by_path = primary * light / passing / total
    return np.log(view.with_it) - gain - np.log(total), by_path, -(1 - light) / total
