"""Images that something smeared along one direction while they were taken: a C-arm that shook, or a patient.

Images without and with a device, from one C-arm pose, show the same edges elsewhere. In one that was smeared, those
across the smear are weaker than in the other, and those along it are not. Exposure, dose, and how sharp a C-arm is, are
nearly the same along all directions. What scattered light and glare take of the contrast is so too, but it changes from
place to place, and a device changes it. So edges are also measured beside what is around them; a smear shows both ways.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, ndimage
from torch import Tensor

from femoreg_torch.fluoro import natural
from femoreg_torch.geometry import Camera, Poses
from femoreg_torch.registration.compared import exposed_in_both
from femoreg_torch.registration.imaging import draw
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Kind, Scene
from femoreg_torch.registration.weights import dilated

_LEVEL = Level(pixel_mm=1.0, step_mm=1.0)
_SIGMA_MM = 1.5  # on the detector, of the edges' Gaussian: coarser than noise, finer than a smear that matters
# On the detector, of Gaussians: slopes that are alike so far around are no edges but shade, and edges are measured
# beside all edges so far around. Of 25 sharp pairs of images of another simulator the least kept was 0.91 as they are
# and 0.98 beside what is around; of four smeared ones 0.80 to 0.93, and 0.72 to 0.89.
_SHADE_MM, _ALIKE_MM = 6.0, 10.0
_FLOOR = 2.0  # of the mean square of all edges, added to that around: where there are hardly any, they stay small
_AROUND_MM = 6.0  # on the detector, beside what one of the images lacks, and beside what is not exposed
_CHANGE = 0.15  # of the logarithm of intensity: one of the images lacks what is there
_LEAST_SHARE = 0.05  # of the image, that can be compared


@dataclass(frozen=True)
class Smear:
    """How the image of a kind differs in sharpness from that of the first kind of the same view (from 0)."""

    kind: Kind
    view: int
    kept: float  # strength of the edges, beside the other image, where it is least; of that where it is greatest


def smears(scene: Scene, poses: Poses) -> list[Smear]:
    """The images of other kinds than the first, each compared with that of the first kind of its view.

    Views that lack one of the two, or have too little exposed that both show, or no edges there, are left out.
    """
    others = [kind for kind in scene.images if kind != scene.first_kind]
    return [
        Smear(kind, view, kept)
        for kind, view in scene.there(others, range(scene.views))
        if scene.there([scene.first_kind], (view,)) and (kept := _kept(scene, poses, kind, view)) is not None
    ]


def _kept(scene: Scene, poses: Poses, kind: Kind, view: int) -> float | None:
    camera = _LEVEL.camera(scene.carm.camera)
    images = [scene.image(each, view) for each in (scene.first_kind, kind)]
    first, other = (_LEVEL.image(image, scene.carm.camera).cpu().double().numpy() for image in images)
    where = _shown_by_both(scene, poses, kind, view)
    if all(map(natural, images)):  # only then it is known how strong a shadow is
        change = ndimage.gaussian_filter(other - first, [_SIGMA_MM / mm for mm in camera.pixel_mm])
        change -= np.median(change[where]) if where.any() else 0.0  # exposures differ
        where &= ~_dilated(np.abs(change) > _CHANGE, camera)
    if where.mean() < _LEAST_SHARE:
        return None
    kept = []
    for measure in (_slopes, _slopes_beside):
        of_first, of_other = (_tensor(measure(image, camera, where)) for image in (first, other))
        if min(map(np.linalg.matrix_rank, (of_first, of_other))) < len(of_first):
            return None
        least, greatest = linalg.eigvalsh(of_other, of_first)
        kept.append(math.sqrt(least / greatest))
    return max(kept)


def _shown_by_both(scene: Scene, poses: Poses, kind: Kind, view: int) -> np.ndarray:
    """Pixels (H, W) of the level that are exposed in both images, away from shutters and from what one lacks."""
    names = [
        name
        for name in poses.camera1_from
        if (scene.first_kind in scene.objects[name].shown_in) != (kind in scene.objects[name].shown_in)
    ]
    camera = poses.camera(view, _LEVEL.camera(scene.carm.camera))
    lacking = ~exposed_in_both(scene, (scene.first_kind, kind), view, _LEVEL)
    if names:
        where = torch.stack([poses.camera_from(name)[view] for name in names])[None]
        lacking |= draw([scene.objects[name] for name in names], where, camera, _LEVEL.step_mm)[0] > 0
    away: Tensor = ~dilated(lacking, _AROUND_MM, camera)
    return away.cpu().numpy()


def _dilated(mask: np.ndarray, camera: Camera) -> np.ndarray:
    return dilated(torch.from_numpy(mask), _AROUND_MM, camera).numpy()


def _slopes(image: np.ndarray, camera: Camera, where: np.ndarray) -> np.ndarray:
    """The slopes (2, N) of an image (H, W) along rows and columns, at the N pixels `where`."""
    sigma = [_SIGMA_MM / mm for mm in camera.pixel_mm]
    return np.stack([ndimage.gaussian_filter(image, sigma, order)[where] for order in ((1, 0), (0, 1))])


def _slopes_beside(image: np.ndarray, camera: Camera, where: np.ndarray) -> np.ndarray:
    """The same, less those around, and beside how strong edges are around."""

    def around(values: np.ndarray, sigma_mm: float) -> np.ndarray:
        """Means (n, N) of values (n, N) at the pixels `where` over those of them that lie around."""
        laid_out = np.zeros((len(values) + 1, *where.shape), np.float32)
        laid_out[:-1, where], laid_out[-1, where] = values, 1
        sigma = [sigma_mm / mm for mm in camera.pixel_mm]
        *totals, known = (ndimage.gaussian_filter(each, sigma, truncate=2.0)[where] for each in laid_out)
        return np.stack(totals) / known

    slopes = _slopes(image, camera, where)
    slopes -= around(slopes, _SHADE_MM)
    (strength,) = around((slopes**2).sum(0, keepdims=True), _ALIKE_MM)
    beside: np.ndarray = slopes / np.sqrt(strength + _FLOOR * strength.mean()).clip(np.finfo(float).tiny)
    return beside


def _tensor(slopes: np.ndarray) -> np.ndarray:
    """The structure tensor (2, 2) of slopes (2, N)."""
    product: np.ndarray = slopes @ slopes.T
    return product
