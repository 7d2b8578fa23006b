"""The shadows of a device in images with and without it, as a function of what it is made of, its pose, and scatter.

Images without and with a device are taken from one C-arm pose, so that all but the device is the same in both. Let Iₐ
and I_d be their intensities and S the light that is scattered into a pixel; then

    I_d = g · ((Iₐ − S) · (1 + h Σ a ℓ)^(−1/h) + S)

with the path ℓ through each region of the device, its attenuation a where it is thin, a factor g between the exposures,
and the hardening h of the beam in it (`registration.imaging.hardened`), which the images tell as well: a tube's light
hardens, that of a simulator of one energy does not. The additive scatter is that of Seibert and
Boone, X-ray scatter removal by deconvolution, Med Phys 15 (1988) 567. Where metal is opaque the shadow is S, whatever
the metal, so that its darkest places tell S, and lighter ones the attenuation. This least squares is sparse and runs on
the CPU, with SciPy, wherever the scene lies.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from torch import Tensor

from femoreg_torch.cores import on_all_cores
from femoreg_torch.drr import project_with_jacobian
from femoreg_torch.geometry import Camera, Poses, transform_points
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.materials.regions import (
    Doubles,
    Indices,
    RegionVoxels,
    filled,
    region_paths,
    region_voxels,
)
from femoreg_torch.registration.scene import Kind, Scene
from femoreg_torch.registration.weights import dilated
from femoreg_torch.volume import Volume

LEVEL = Level(pixel_mm=1.55, step_mm=0.5)
LEAST_PIXELS = 100  # of a view that counts
TWIST = np.array([0.01] * 3 + [1.0] * 3)  # rad and mm: one unit of the pose
# Squared coefficient of variation of metal's attenuation over the spectrum of a tube at 75 kV, behind 200 mm of water:
# 0.35, by the tables of `volume.materials`, 0.22 at 60 kV and 0.5 at 100 kV. Thick metal, which lets the hardest light
# through, hardens the beam by less than the law of `hardened` says: 5 mm of steel as if it were 0.1. Between the two,
# until the images tell it.
_HARDENING, _HARDENING_DEVIATION = 0.2, 0.1
_LEAST_HARDENING, _MOST_HARDENING = 0.01, 0.6  # next to one energy, and beyond a tube of 100 kV
_LEAST_PATH_MM = 0.3  # of a ray through the device, for its pixel to count
_AROUND_MM = 3.0  # on the detector: pixels beyond the shadow that count, so that the device may move
_FAINTEST = 1e-3  # 1/mm
_MOST_ATTENUATION = 2.5  # 1/mm: steel at 45 keV, of which 2 mm are opaque
_VARIATION = 5.0  # weight of a step of 1/mm between all blocks
_FLAT = 0.01  # 1/mm: steps that are none
_TOLD_WITHIN = 0.3  # deviation of the logarithm of what a named material attenuates; nobody tells the tube's voltage
_TOLD_WEIGHT = 1 / 200  # of one named material beside all pixels, whose misfits are alike over wide regions
_HARDENING_WEIGHT = 1 / 50  # of the common tube beside them; with 1/200 named devices were placed less well
_MISFIT = 0.05  # of a logarithm of intensity; larger ones (something else has changed) count less
_BEYOND_WHITE = 1.0  # of a logarithm of intensity: light that a saturated image may have too much of
_LEAST_PASSING = 1e-3  # of 1 + h Σ a ℓ, where a motion of the device takes its path below nothing
_CORNERS = 4  # of the box around the device: scattered light is interpolated between them
_AT_HARDENING, TURN = -7, slice(-6, None)  # where hardening and twist stand among the parameters, see `solve`


@dataclass(frozen=True, eq=False)
class Device:
    """A device in regions, each of one attenuation."""

    name: str
    kind: Kind  # of the images that show it
    share: Volume  # of every voxel that is inside
    owner: Tensor  # (Z, Y, X): the region of every voxel, −1 where it is empty
    regions: int
    voxels: RegionVoxels
    touching: Indices | None  # (n, 3): pairs of regions, and the faces between them
    told: Doubles | None  # (regions,) attenuations that the case names
    sharp: bool  # whether it is of solids with surfaces, so that the length of every path is known

    def filled(self, attenuation: Doubles) -> Volume:
        """Its attenuation, 1/mm, from that of its regions."""
        return filled(self.share, self.owner, attenuation)


def device_of(
    name: str,
    kind: Kind,
    share: Volume,
    owner: Tensor,
    regions: int,
    touching: Indices | None = None,
    told: Doubles | None = None,
    *,
    sharp: bool = False,
) -> Device:
    """A device whose regions are told by their `owner` (Z, Y, X), −1 where it is empty; all else as in `Device`."""
    return Device(name, kind, share, owner, regions, region_voxels(share, owner, regions), touching, told, sharp)


@dataclass(frozen=True, eq=False)
class Pair:
    """The images of one view without and with a device, in pixels of `LEVEL`."""

    view: int
    without: Doubles  # (H · W,) intensities
    with_it: Doubles
    told: Tensor  # (H, W), bool: no shutter shades it, and it is not saturated, or without the device as well
    white: Tensor  # (H, W), bool: saturated without the device


def pairs_of(scene: Scene, kind: Kind) -> list[Pair]:
    """The images of the first kind, and those of another kind, of all views that have both."""

    def intensity(k: Kind, view: int) -> Doubles:
        image = LEVEL.image(scene.image(k, view), scene.carm.camera)
        return (-image.cpu()).exp().flatten().double().numpy()

    def exposed(k: Kind, view: int) -> Tensor:
        field = scene.field(k, view)
        return torch.ones_like(scene.image(k, view), dtype=torch.bool) if field is None else field

    def unsaturated(k: Kind, view: int) -> Tensor:
        image = scene.image(k, view)
        return image > image.where(exposed(k, view), math.inf).amin()  # where nothing is exposed, no pixel is

    def pair(view: int) -> Pair:
        first, camera = scene.first_kind, scene.carm.camera
        both = exposed(first, view) & exposed(kind, view)
        dark = unsaturated(first, view)
        hidden = dark & ~unsaturated(kind, view)
        told, white = LEVEL.field(both & ~hidden, camera).cpu(), ~LEVEL.field(dark, camera).cpu()
        return Pair(view, intensity(first, view), intensity(kind, view), told, white)

    return on_all_cores(pair, [view for _, view in scene.there([kind], range(scene.views))], scene.device)


@dataclass(frozen=True, eq=False)
class View:
    """The pixels of one view that the device covers, and those around."""

    pair: Pair
    pixels: Indices  # (N,) of the image of `LEVEL`
    paths: csr_array  # (N, K) mm through each region
    changes: Doubles  # (N, 6) of the path · attenuation by a twist, in units of `TWIST`
    without: Doubles  # (N,) intensities
    with_it: Doubles
    white: NDArray[np.bool_]  # (N,): saturated without the device
    corners: Doubles  # (N, 4): share of each corner of the box around the device


def views_of(
    scene: Scene, poses: Poses, device: Device, pairs: Sequence[Pair], volume: Volume | None = None
) -> list[View]:
    """What pairs of images show of a device, of those that show enough of it.

    With its `volume` all pairs, and how their image changes as the device moves.
    """

    def look(pair: Pair) -> View | None:
        camera = poses.camera(pair.view, LEVEL.camera(scene.carm.camera))
        pose = poses.camera_from(device.name)[pair.view]
        paths = region_paths(device.voxels, pose, camera)
        covered = torch.from_numpy(paths.sum(1)).reshape(camera.shape) > _LEAST_PATH_MM
        if volume is not None:
            covered = dilated(covered, _AROUND_MM, camera)
        chosen = np.flatnonzero((covered & pair.told).flatten().numpy())
        changes = np.zeros((len(chosen), 6))
        if volume is not None:
            centre = transform_points(pose, scene.objects[device.name].reference_point[None])[0]
            _, jacobian = project_with_jacobian(volume, pose[None], camera, centre, LEVEL.step_mm)
            # twists of camera 1 to this one's
            turn = torch.block_diag(*[poses.camera_from_camera1[pair.view][:3, :3]] * 2)
            changes = (jacobian[0].flatten(0, 1)[chosen].double() @ turn).numpy() * TWIST
        elif len(chosen) < LEAST_PIXELS:
            return None
        without, with_it, white = pair.without[chosen], pair.with_it[chosen], pair.white.flatten().numpy()[chosen]
        return View(pair, chosen, paths[chosen], changes, without, with_it, white, _corners(chosen, camera))

    return [view for view in on_all_cores(look, pairs) if view is not None]


def first_guess(seen: list[View], attenuation: Doubles) -> Doubles:
    """Parameters, see `solve`, with these attenuations, and scatter that leaves the darkest pixels some light."""
    scatter = np.repeat([0.7 * _darkest(view) for view in seen], _CORNERS)
    return np.concatenate([attenuation, scatter, np.zeros(len(seen)), [_HARDENING], np.zeros(6)])


def _darkest(view: View) -> float:
    """Nearly the darkest intensity behind the device."""
    return float(np.quantile(view.with_it, 0.03)) if len(view.with_it) else 1.0


def solve(seen: list[View], device: Device, begin: Doubles, iterations: int) -> tuple[Doubles, int]:
    """Attenuations (K), scattered light (4 V), log factors between exposures (V), hardening, a twist (6); evaluations.

    Least squares of the logarithms of intensity, robust, plus, over the faces between `touching` regions, the total
    variation of the attenuation, as a device is of few materials (Rudin, Osher, Fatemi, Physica D 60 (1992) 259), and
    how far the attenuations are from those that the case names, and the hardening from that of a common tube. The
    hardening stays what it is where something else could take its place: attenuations of `touching` regions, the shape
    of what is not `sharp`, or the depth of what one view shows.
    """
    views, regions, touching = len(seen), device.regions, device.touching
    darkest = np.repeat([_darkest(view) for view in seen], _CORNERS)
    unit = np.concatenate([np.ones(regions), darkest, np.ones(views + 1 + 6)])
    held = begin[_AT_HARDENING]
    free = touching is None and device.sharp and views > 1
    softest, hardest = (_LEAST_HARDENING, _MOST_HARDENING) if free else (held, held)
    exposures, turns = np.full(views, 0.5), np.full(6, 3.0)
    highest = np.concatenate([np.full(regions, _MOST_ATTENUATION), np.inf * darkest, exposures, [hardest], turns])
    lowest = np.concatenate([np.zeros(regions + len(darkest)), -exposures, [softest], -turns])
    count = max(1, sum(len(view.with_it) for view in seen))
    by_region = [view.paths.T for view in seen]

    def cost(y: Doubles) -> tuple[float, Doubles]:
        x = y * unit
        value, slope = 0.0, np.zeros_like(x)
        for n, view in enumerate(seen):
            residual, by_path, by_scatter, by_hardening = residuals(x, seen, n, regions)
            root = np.sqrt(1 + (residual / _MISFIT) ** 2)
            value += (root - 1).sum() / count
            push = residual / root / (_MISFIT**2 * count)
            slope[:regions] += by_region[n] @ (push * by_path)
            slope[scatter_of(n, regions)] += (push * by_scatter) @ view.corners
            slope[regions + _CORNERS * views + n] -= push.sum()
            slope[_AT_HARDENING] += push @ by_hardening
            slope[TURN] += (push * by_path) @ view.changes
        if touching is not None and len(touching):
            one, other, faces = touching.T
            step = x[one] - x[other]
            soft = np.sqrt(step**2 + _FLAT**2)
            share = _VARIATION * faces / faces.sum()
            value += (share * (soft - _FLAT)).sum()
            np.add.at(slope, one, share * step / soft)
            np.add.at(slope, other, -share * step / soft)
        away = (x[_AT_HARDENING] - _HARDENING) / _HARDENING_DEVIATION
        value += 0.5 * _HARDENING_WEIGHT * away**2
        slope[_AT_HARDENING] += _HARDENING_WEIGHT * away / _HARDENING_DEVIATION
        if device.told is not None:
            off = np.log(np.maximum(x[:regions], _FAINTEST) / device.told) / _TOLD_WITHIN
            value += 0.5 * _TOLD_WEIGHT * (off**2).sum()
            slope[:regions] += _TOLD_WEIGHT * off / (_TOLD_WITHIN * np.maximum(x[:regions], _FAINTEST))
        return value, slope * unit

    bounds = list(zip(lowest / unit, highest / unit, strict=True))
    options = {"maxiter": iterations}
    found = minimize(cost, begin / unit, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x) * unit, int(found.nfev)


def scatter_of(n: int, regions: int) -> slice:
    """Where the scattered light of view n stands among the parameters."""
    return slice(regions + _CORNERS * n, regions + _CORNERS * (n + 1))


def hardening_of(x: Doubles) -> float:
    """The hardening among the parameters."""
    return float(x[_AT_HARDENING])


def _corners(pixels: Indices, camera: Camera) -> Doubles:
    """Shares (N, 4) of the corners of the box around pixels, by bilinear interpolation."""
    if not len(pixels):
        return np.zeros((0, _CORNERS))
    rows, columns = np.divmod(pixels, camera.shape[1])
    u = (columns - columns.min()) / max(1, np.ptp(columns))
    v = (rows - rows.min()) / max(1, np.ptp(rows))
    return np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)


def residuals(x: Doubles, seen: list[View], n: int, regions: int) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Differences of the logarithms of intensity (N,) of view n, and their derivatives by Σ a ℓ, by S and by h.

    Where the image without the device is saturated, up to 2.7 times as much light as it shows may have been there: what
    that explains is no difference.
    """
    view = seen[n]
    gain = x[regions + _CORNERS * len(seen) + n]
    scatter = view.corners @ x[scatter_of(n, regions)]
    integrals = view.paths @ x[:regions] + view.changes @ x[TURN]
    h = hardening_of(x)
    passing = np.maximum(1 + h * integrals, _LEAST_PASSING)
    light = passing ** (-1 / h)
    primary = np.maximum(view.without - scatter, 1e-3 * view.without)
    total = primary * light + scatter
    by_path = primary * light / passing / total
    by_hardening = -primary * light * (np.log(passing) / h - integrals / passing) / (h * total)
    residual = np.log(view.with_it) - gain - np.log(total)
    residual -= np.where(view.white, residual.clip(0, _BEYOND_WHITE), 0)
    return residual, by_path, -(1 - light) / total, by_hardening
