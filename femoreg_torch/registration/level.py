"""How finely a stage looks: pixels of a physical size on the detector, whatever the images' own, and voxels to fit."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.fluoro import binned
from femoreg_torch.geometry import Camera
from femoreg_torch.settings import check_within
from femoreg_torch.volume import Volume, changes_in_place, halved, sharpened

_ROUNDING_MM = 1e-6
# What was made of volumes, for later stages, and the version of the data that it was made of.
_halves: WeakKeyDictionary[Volume, tuple[int, Volume]] = WeakKeyDictionary()
_sharpened: WeakKeyDictionary[Volume, tuple[int, Volume]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Level:
    """How finely a stage looks."""

    pixel_mm: float  # edge of a pixel on the detector, as nearly as whole multiples of the images' pixels allow
    step_mm: float  # along the rays

    def __post_init__(self) -> None:
        check_within(self, pixel_mm=(0.01, 100), step_mm=(0.05, 100))

    def camera(self, camera: Camera) -> Camera:
        """The camera of images at this level, given that of the images."""
        return camera.downsampled(binning(self.pixel_mm, camera))

    def image(self, image: Tensor, camera: Camera) -> Tensor:
        """An attenuation image (H, W) of the given camera with the pixels of this level."""
        return _binned(image, changes_in_place(image), binning(self.pixel_mm, camera))

    def volume(self, volume: Volume, *, sharp: bool = False) -> Volume:
        """A volume with voxels as large as the steps of this level allow: its own, or twice, four times … as large.

        With `sharp` it is as sharp as what its voxels are means of, see `sharpened`.
        """
        if 2 * max(volume.spacing_mm) > self.step_mm + _ROUNDING_MM:
            return _made(sharpened, volume, _sharpened) if sharp else volume
        return self.volume(_made(halved, volume, _halves), sharp=sharp)

    def field(self, exposed: Tensor, camera: Camera) -> Tensor:
        """The pixels of this level, bool, that lie wholly in a mask (H, W) of the given camera."""
        return F.max_pool2d((~exposed)[None].float(), binning(self.pixel_mm, camera))[0] == 0


def _made(
    make: Callable[[Volume], Volume], volume: Volume, known: WeakKeyDictionary[Volume, tuple[int, Volume]]
) -> Volume:
    """What is made of a volume, computed once (and again if its data were changed)."""
    version, made = known.get(volume, (-1, volume))
    if version != changes_in_place(volume.data):
        made = make(volume)
        known[volume] = changes_in_place(volume.data), made
    return made


@functools.lru_cache(maxsize=24)
def _binned(image: Tensor, version: int, factor: int) -> Tensor:
    """`binned`, kept for the stages that follow at the same level; `version` counts changes of the image in place."""
    return binned(image, factor)


def binning(pixel_mm: float, camera: Camera) -> int:
    """By which whole factor to average a camera's pixels so that their edge, on a log scale, is nearest to `pixel_mm`.

    The edge of pixels that are no squares is the geometric mean of their sides.
    """
    ratio = pixel_mm / camera.mean_pixel_mm
    below = max(1, math.floor(ratio))
    return below if ratio**2 <= below * (below + 1) else below + 1
