"""What is drawn besides the objects: scattered light and soft tissue."""

from dataclasses import dataclass, replace

from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.settings import check_within
from femoreg_torch.volume import Volume

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

    def image(self, integrals: Tensor) -> Tensor:
        """What is seen of line integrals."""
        return -((-integrals).exp() + self.scatter).log() if self.scatter else integrals

    def slope(self, integrals: Tensor) -> Tensor:
        """Its derivative by them."""
        return 1 / (1 + self.scatter * integrals.exp())


PLAIN = Imaging()


def tissue_integrals(tissue: Volume, camera_from_tissue: Tensor, camera: Camera) -> Tensor:
    """Line integrals (H, W) of the soft tissue: on coarse pixels, and interpolated."""
    factor = binning(_TISSUE.pixel_mm, camera)
    rows, columns = (-(-n // factor) * factor for n in camera.shape)
    wide = replace(camera, shape=(rows, columns)).downsampled(factor)
    coarse = project([tissue], camera_from_tissue[None, None], wide, _TISSUE.step_mm)
    fine = F.interpolate(coarse[None], size=(rows, columns), mode="bicubic", antialias=True)[0, 0]
    return fine[: camera.shape[0], : camera.shape[1]].contiguous()
