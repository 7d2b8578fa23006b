"""From raw intensity (bone dark) to attenuation (bone bright), and to coarser pixels."""

import math

import cv2
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.errors import InputError

_MOST_ATTENUATION = 12.0  # of a patient: 45 cm of water at 60 keV are 9
_EXTREME = 60.0  # attenuation of which float32 can still take the intensity
_USUAL_RANGE = 8.0  # of attenuation in an image of a hip
_MOST_BELOW_ZERO = 0.01  # share of pixels; noise of a dark detector leaves fewer where a patient lies
_RAISED = 0.5  # of the greatest value: a hip leaves a hundredth of the open beam, a hand a third
_SPARSE = 8  # every so many-th pixel tells what half of an image is
_SIGMA_PX = math.sqrt(2.0)  # of the smoothing that finds I0: variance 2 px², as xReg does (itkIntensLogTrans)


def attenuation_image(raw: Tensor, field: Tensor | None = None) -> Tensor:
    """Attenuation −log(I / I0) of a raw image (H, W), bone bright, dimensionless.

    I0, the unattenuated beam, is the maximum of a lightly smoothed copy within the exposed `field` (H, W), bool (None:
    all of it), so that no single hot pixel sets it; where a pixel counts more, its attenuation is slightly negative.
    Pixels of zero or less count as the smallest positive pixel. Raises `InputError` if no pixel is positive.
    """
    check_intensity(raw, "image")
    darkest = torch.where(raw > 0, raw, math.inf).min().item()  # ten times as fast as a list of the positive pixels
    smooth = cv2.GaussianBlur(raw.float().numpy(), (0, 0), _SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
    open_beam = smooth.max() if field is None else smooth[field.numpy()].max()
    return math.log(float(open_beam)) - raw.float().clamp_min(darkest).log()


def intensity_of(attenuation: Tensor) -> Tensor:
    """Intensities (H, W), up to a factor, whose logarithms an attenuation image holds; at most 1.

    Values that are not `natural` are of another scale: they are brought to a range of `_USUAL_RANGE` first.
    """
    above = attenuation - attenuation.min()
    return (-(above if natural(attenuation) else above * (_USUAL_RANGE / above.max()))).exp()


def below_zero(raw: Tensor, padding: Tensor | None = None) -> str | None:
    """In words, that many pixels of a raw image (H, W) lie below 0; None if few do. `padding`, bool, holds no image."""
    below = raw < 0 if padding is None else (raw < 0) & ~padding
    share = int(below.count_nonzero()) / raw.numel()
    if share <= _MOST_BELOW_ZERO:
        return None
    return (
        f"has {100 * share:.0f} % of its pixels below 0, and no intensity is: was too much taken off for the dark "
        "detector? They count as the darkest pixel above 0"
    )


def check_intensity(raw: Tensor, where: str) -> None:
    """Raises `InputError` that starts with `where` if no pixel of a raw image (H, W) is positive."""
    if not raw.max() > 0:
        raise InputError(f"{where}: no pixel is positive, a raw intensity image was expected. Is its intensity `log`?")


def raised(raw: Tensor) -> str | None:
    """In words, an offset that seems to be in all values of a raw image (H, W): nothing in it is near black."""
    low, high = (float(value) for value in raw.aminmax())
    if low <= _RAISED * high:
        return None
    return f"has values of {low:.6g} to {high:.6g}: was something added to all of them? Zero is to be no light"


def downsample(image: Tensor, factor: int) -> Tensor:
    """Block averages (..., H // factor, W // factor), float32, of images (..., H, W); as `Camera.downsampled`."""
    coarse = F.avg_pool2d(image.float().reshape(-1, 1, *image.shape[-2:]), factor)
    return coarse.reshape(*image.shape[:-2], *coarse.shape[-2:])


def natural(attenuation: Tensor) -> bool:
    """Whether an attenuation image (H, W) may hold natural logarithms of intensities.

    Where half of it is darker than any patient, they are logarithms of another base, or grey values.
    """
    return bool(attenuation[::_SPARSE, ::_SPARSE].median() - attenuation.min() <= _MOST_ATTENUATION)


def binned(attenuation: Tensor, factor: int) -> Tensor:
    """An attenuation image (H, W) as a detector with pixels so many times larger sees it, (H // factor, W // factor).

    Such pixels average intensities. Values that are not `natural` are averaged themselves.
    """
    if factor == 1 or not natural(attenuation):
        return downsample(attenuation, factor)
    return -downsample((-attenuation).clamp(-_EXTREME, _EXTREME).exp(), factor).log()
