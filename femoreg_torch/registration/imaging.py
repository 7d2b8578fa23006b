"""What is seen of objects: metal that hardens the beam; and besides them, scattered light and soft tissue."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.geometry import Camera
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.settings import check_within
from femoreg_torch.volume import Volume

_FAINT = 1.5  # line integral: of what is fainter, a saturated image shows next to nothing
_AS_GUESSED = 2.5  # factor of the scattered light
_FINE_PIXELS = 2.5  # pixels per voxel, and more: far finer than anything that voxels show
_TISSUE = Level(pixel_mm=3.1, step_mm=3.0)  # how finely the soft tissue is drawn; it is smooth


@dataclass(frozen=True)
class Imaging:
    """How the images differ from plain line integrals of the objects.

    `scatter` is the scattered light per primary light behind the patient but for what is drawn: it fills dark shadows,
    so that −log flattens there, and their edges seem to lie farther out. `tissue` is the soft tissue's attenuation in
    the images per attenuation in the CT (harder light); 0 draws none, nor does a scene without a CT.
    """

    scatter: float = 0.0
    tissue: float = 0.0

    def __post_init__(self) -> None:
        check_within(self, scatter=(0, 10), tissue=(0, 10))

    def as_seen(self, scatter: float | None) -> "Imaging":
        """With what the images tell of the scattered light, if they do and say more or less by a factor of 2.5.

        A guess that the images nearly agree with stays, so that the noise of what they tell does no harm.
        """
        if not scatter or not self.scatter or abs(math.log(scatter / self.scatter)) < math.log(_AS_GUESSED):
            return self
        return replace(self, scatter=scatter)


PLAIN = Imaging()


def below_white(integrals: Tensor, white: Tensor | None) -> Tensor:
    """What a saturated image shows of line integrals (..., H, W): L (1 − exp(−(L / 1.5)²)) where it is `white` (H, W).

    What takes less light than the image has too much of leaves no shadow there. How much that is nobody tells. By this
    form faint things are not drawn, and dense ones as they are, so that nothing is drawn along the border of the white.
    """
    if white is None:
        return integrals
    return torch.where(white, -integrals * torch.expm1(-((integrals / _FAINT) ** 2)), integrals)


def below_white_slope(integrals: Tensor, white: Tensor) -> Tensor:
    """The derivative of `below_white` by the integrals (..., H, W)."""
    squared = (integrals / _FAINT) ** 2
    return torch.where(white, 2 * squared * (-squared).exp() - torch.expm1(-squared), 1)


def filled(integrals: Tensor, scatter: Tensor | None) -> Tensor:
    """What is seen of line integrals (..., H, W) where light per primary light, () or (H, W), fills their shadows."""
    return integrals if scatter is None else -((-integrals).exp() + scatter).log()


def filled_slope(integrals: Tensor, scatter: Tensor | None) -> Tensor:
    """The derivative of `filled` by the integrals (..., H, W)."""
    return torch.ones_like(integrals) if scatter is None else 1 / (1 + scatter * integrals.exp())


def hardened(integrals: Tensor, hardening: float) -> Tensor:
    """What line integrals L of an object's attenuation come to in a beam of many energies: ln(1 + h L) / h.

    The light that passes is the mean of exp(−a ℓ) over the spectrum. For attenuations a that are distributed as a gamma
    distribution, of which h is the squared coefficient of variation, that mean is (1 + h L)^(−1/h), with L of the mean
    attenuation (the distribution's Laplace transform). Thin metal thus takes more light per millimetre than thick.
    Less than nothing, as beside the edges of sharpened volumes, stays what it is.
    """
    if not hardening:
        return integrals
    return torch.where(integrals > 0, torch.log1p(hardening * integrals.clamp_min(0)) / hardening, integrals)


def hardened_slope(image: Tensor, hardening: float) -> Tensor:
    """The derivative of `hardened` by the integrals, 1 / (1 + h L), from what they came to (..., H, W)."""
    return (-hardening * image.clamp_min(0)).exp()


def draw(things: Sequence[RigidObject], placed: Tensor, camera: Camera, step_mm: float) -> Tensor:
    """What objects, all together, add to images (P, H, W); they lie at `placed` (P, O, 4, 4)."""
    images = (
        hardened(project(thing.volume, placed[:, n], camera, step_mm), thing.hardening)
        for n, thing in enumerate(things)
    )
    return functools.reduce(Tensor.add, images)


def draw_with_jacobian(
    thing: RigidObject, pose: Tensor, camera: Camera, centre: Tensor, step_mm: float, *, intrinsics: bool
) -> tuple[Tensor, Tensor]:
    """What one object adds to images (B, H, W), and the derivatives of that; see `drr.project_with_jacobian`."""
    integrals, jacobian = project_with_jacobian(thing.volume, pose, camera, centre, step_mm, intrinsics=intrinsics)
    if not thing.hardening:
        return integrals, jacobian
    image = hardened(integrals, thing.hardening)
    return image, jacobian.mul_(hardened_slope(image, thing.hardening)[..., None])


def tissue_integrals(tissue: Volume, camera_from_tissue: Tensor, camera: Camera) -> Tensor:
    """Line integrals (H, W) of the soft tissue: on coarse pixels, and interpolated."""

    def drawn(wide: Camera) -> Tensor:
        return project([tissue], camera_from_tissue[None, None], wide, _TISSUE.step_mm)

    return _interpolated(drawn, camera, binning(_TISSUE.pixel_mm, camera))


def draw_still(thing: RigidObject, pose: Tensor, camera: Camera, step_mm: float) -> Tensor:
    """What one object at a pose (4, 4) shows, (H, W), where no derivative is asked for.

    On pixels far smaller than its voxels it is drawn on twice as large ones, and interpolated: of the squared edges of
    a pelvis of 1 mm voxels, on pixels of 0.39 mm, that changed one thousandth.
    """

    def drawn(wide: Camera) -> Tensor:
        return draw([thing], pose[None, None], wide, step_mm)

    if min(thing.volume.spacing_mm) < _FINE_PIXELS * max(camera.pixel_mm):
        return drawn(camera)[0]
    return _interpolated(drawn, camera, 2)


def _interpolated(drawn: Callable[[Camera], Tensor], camera: Camera, factor: int) -> Tensor:
    """The image (H, W) for a camera, from one (1, h, w) that is drawn on pixels larger by a whole factor."""
    rows, columns = (-(-n // factor) * factor for n in camera.shape)
    coarse = drawn(replace(camera, shape=(rows, columns)).downsampled(factor))
    fine = F.interpolate(coarse[None], size=(rows, columns), mode="bicubic", antialias=True)[0, 0]
    return fine[: camera.shape[0], : camera.shape[1]].contiguous()
