"""Shadows of beads beside the edges of a device, measured again once its pose is known.

A bead on the surface of a device often stands over its silhouette: one half before metal, the other beside it. A
quadratic surface cannot follow that step, and takes part of it for the bead: on simulated devices such shadows were off
by 0.28 pixels (rms along each axis), always to the same side, while those in bone were off by 0.03. So the model of the
device is drawn into the window, and the image is fitted as a surface plus a quadratic of the metal in the beam, device
and bead together, since beam hardening and scattered light make the second millimetre darken less than the first. What
is left is 0.1 pixels; the fit says which shadows remain worse than others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import least_squares
from torch import Tensor

from femoreg_torch.beads.bundle import Sight
from femoreg_torch.beads.model import Beads
from femoreg_torch.beads.spots import blur_on, disc, quadratic, shadow, window_px
from femoreg_torch.case import Case, Model
from femoreg_torch.geometry import Camera, Poses, transform_points
from femoreg_torch.volume import read_bodies, read_mesh

Array = NDArray[np.float64]

_PARTS = 3  # a pixel's edge is cut into: its value is the mean of their rays
_ASIDE_PX = 3  # drawn beside the window, for the blur
_EDGE_MM = 0.05  # by which metal in the beam differs in a window before it matters
_DENSER = 1.5  # first guess of a bead's attenuation by that of the device
_NOISE = 0.01  # of attenuation: residuals beyond count less (soft L1)


@dataclass(frozen=True, eq=False)
class Metal:
    """Closed surfaces of a device, mm in its space, and how much each attenuates by the densest."""

    triangles: tuple[Array, ...]  # each (F, 3, 3)
    weights: tuple[float, ...]

    def moved(self, camera_from_device: Array) -> "Metal":
        """The same in the frame of a camera."""
        turn, shift = camera_from_device[:3, :3], camera_from_device[:3, 3]
        return replace(self, triangles=tuple(faces @ turn.T + shift for faces in self.triangles))


def read_metal(model: Model) -> Metal | None:
    """The surfaces of a model; None where it is not all meshes. Raises `InputError` for a mesh that is damaged."""
    if not model.solids or any(part.labels is not None for part in model.solids):
        return None
    names = [part.body for part in model.solids if part.body is not None]
    bodies = read_bodies(model.path, names) if names else {}
    meshes = [read_mesh(part.path) if part.body is None else bodies[part.body] for part in model.solids]
    hu = np.array([part.solid_hu for part in model.solids])
    weights = hu / hu.max() if hu.max() > 0 else np.ones(len(hu))
    return Metal(tuple(np.asarray(mesh.triangles, np.float64) for mesh in meshes), tuple(weights.tolist()))


def beside_metal(
    sights: Sequence[Sight],
    case: Case,
    images: Mapping[str, Sequence[Tensor | None]],
    beads: Sequence[Beads],
    metal: Mapping[str, Metal | None],
    poses: Poses,
) -> list[Sight]:
    """The shadows measured again, with the metal of the objects where `poses` have them, and how well each is known.

    `images` are attenuation (H, W) of every view of the case, by kind. Shadows that cannot be measured again stay where
    they are, as uncertain as the worst.
    """
    camera = case.carm.camera
    known = {thing.object: thing for thing in beads}
    fits = []
    for sight in sights:
        kind = sight.kind
        assert kind is not None  # of a shadow that was seen in an image of the case
        image = images[kind][sight.view]
        assert image is not None
        there = [
            surfaces.moved(poses.camera_from(name)[sight.view].numpy())
            for name, surfaces in metal.items()
            if surfaces is not None and kind in (case.objects[name].images or case.kinds)
        ]
        thing = known[sight.object]
        place = transform_points(poses.camera_from(sight.object)[sight.view], thing.points[sight.bead][None])
        radius = thing.diameter_mm / 2 * camera.sdd_mm / float(place[0, 2]) / camera.mean_pixel_mm
        fits.append(measured_again(image.double().numpy(), sight.pixel, radius, thing.diameter_mm, there, camera))
    deviations = [fit[1] for fit in fits if fit is not None]
    if not deviations:
        return list(sights)
    usual, worst = float(np.median(deviations)), max(deviations)
    return [
        replace(sight, spread=max(1.0, worst / usual))
        if fit is None
        else replace(sight, pixel=fit[0], spread=max(1.0, fit[1] / usual))
        for sight, fit in zip(sights, fits, strict=True)
    ]


def in_beam(metal: Metal, camera: Camera, columns: Array, rows: Array) -> Array:
    """Millimetres (P,) of metal, by its weight, along the rays of pixels (P,); surfaces in the frame of the camera.

    Sum of the distances at which a ray leaves a closed surface less those at which it enters (Möller and Trumbore,
    J Graph Tools 2 (1997) 21). The rays of trimesh need packages that users of beads do not have.
    """
    scale = camera.sdd_mm / np.array([camera.pixel_mm[1], camera.pixel_mm[0]])
    middle = np.array(camera.principal_point_px)
    rays = np.concatenate([(np.stack([columns, rows], 1) - middle) / scale, np.ones((len(columns), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    lengths = np.zeros(len(rays))
    for faces, weight in zip(metal.triangles, metal.weights, strict=True):
        pixels = faces[..., :2] / faces[..., 2:] * scale + middle
        low, high = pixels.min(1), pixels.max(1)
        near = (high >= (columns.min(), rows.min())).all(1) & (low <= (columns.max(), rows.max())).all(1)
        for first, second, third in faces[near]:
            one, other = second - first, third - first
            across = np.cross(rays, other)
            facing = across @ one  # positive where the ray enters
            scaled = 1 / np.where(np.abs(facing) < 1e-12, np.inf, facing)
            u = across @ -first * scaled
            beside = np.cross(-first, one)
            v = rays @ beside * scaled
            hit = (u >= 0) & (v >= 0) & (u + v <= 1)
            lengths -= np.where(hit, np.sign(facing) * float(beside @ other) * scaled, 0) * weight
    return lengths


def measured_again(
    image: Array,
    pixel: tuple[float, float],
    radius_px: float,
    diameter_mm: float,
    metal: Sequence[Metal],
    camera: Camera,
) -> tuple[tuple[float, float], float] | None:
    """The centre (column, row) of a shadow near a pixel of an attenuation image (H, W), and its deviation, px.

    `metal` is in the frame of the camera. Where it has no edge in the window, or does not explain what the image shows
    there, the centre stays as it is. The deviation along each axis is that of the fit's residuals. None where the
    window leaves the image.
    """
    blur_px = blur_on(camera.mean_pixel_mm)
    half = window_px(radius_px, blur_px)
    column, row = round(pixel[0]), round(pixel[1])
    if not (half <= column < image.shape[1] - half and half <= row < image.shape[0] - half):
        return None
    columns, rows, inside = disc(half)
    u, v = columns[inside], rows[inside]
    values = image[row - half : row + half + 1, column - half : column + half + 1][inside]
    around = quadratic(u, v, half)
    drawn = sum((_drawn(part, camera, column, row, half, blur_px)[inside] for part in metal), np.zeros(len(u)))

    def plain(parameters: Array) -> Array:
        bead = shadow(radius_px, np.hypot(u - parameters[0], v - parameters[1]), blur_px)
        return _left(values, np.column_stack([bead, around]))

    def beside(parameters: Array) -> Array:
        bead = diameter_mm * shadow(radius_px, np.hypot(u - parameters[0], v - parameters[1]), blur_px)
        total = drawn + parameters[2] * bead
        return _left(values, np.column_stack([total, total**2, around]))

    start = [pixel[0] - column, pixel[1] - row]
    free = len(values) - around.shape[1] - 5
    simple = least_squares(plain, start, x_scale=0.1, loss="soft_l1", f_scale=_NOISE)
    if float(np.ptp(drawn)) > _EDGE_MM:
        fit = least_squares(beside, [*start, _DENSER], x_scale=0.1, loss="soft_l1", f_scale=_NOISE)
        moved = float(np.hypot(*(fit.x[:2] - start)))
        if fit.cost < simple.cost and fit.x[2] > 0 and moved <= radius_px:
            return (float(column + fit.x[0]), float(row + fit.x[1])), _deviation(fit.jac, beside(fit.x), free)
    return pixel, _deviation(simple.jac, plain(simple.x), free)


def _left(values: Array, terms: Array) -> Array:
    """What a linear fit leaves."""
    return np.asarray(values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0])


def _deviation(jacobian: Array, left: Array, free: int) -> float:
    """Of the first two parameters, root mean square."""
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * float(left @ left) / max(free, 1)
    return float(np.sqrt(covariance.diagonal()[:2].mean()))


def _drawn(metal: Metal, camera: Camera, column: int, row: int, half: int, blur_px: float) -> Array:
    """Metal in the beam, mm, of a window (2 · half + 1)² about a pixel, blurred as the detector does."""
    reach = half + _ASIDE_PX
    offsets = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    line = (np.arange(-reach, reach + 1)[:, None] + offsets).ravel()
    rows, columns = np.meshgrid(line + row, line + column, indexing="ij")
    fine = in_beam(metal, camera, columns.ravel(), rows.ravel())
    mean = fine.reshape(2 * reach + 1, _PARTS, 2 * reach + 1, _PARTS).mean((1, 3))
    return np.asarray(ndimage.gaussian_filter(mean, blur_px)[_ASIDE_PX:-_ASIDE_PX, _ASIDE_PX:-_ASIDE_PX])
