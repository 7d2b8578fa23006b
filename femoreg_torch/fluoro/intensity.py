"""From raw intensity (bone dark) to attenuation (bone bright), and to coarser pixels."""

import math

import cv2
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.errors import InputError

_MOST_ATTENUATION = 12.0  # of a patient: 45 cm of water at 60 keV are 9
_EXTREME = 60.0  # attenuation of which float32 can still take the intensity
_SPARSE = 8  # every so many-th pixel tells what half of an image is
_SIGMA_PX = math.sqrt(2.0)  # of the smoothing that finds I0: variance 2 px², as xReg does (itkIntensLogTrans)


def attenuation_image(raw: Tensor, field: Tensor | None = None) -> Tensor:
    """Attenuation −log(I / I0) of a raw image (H, W), bone bright, dimensionless.

    I0, the unattenuated beam, is the maximum of a lightly smoothed copy within the exposed `field` (H, W), bool (None:
    all of it), so that no single hot pixel sets it; where a pixel counts more, its attenuation is slightly negative.
    Pixels of zero or less count as the smallest positive pixel. Raises `InputError` if no pixel is positive.
    """
    positive = raw[raw > 0]
    if positive.numel() == 0:
        raise InputError("image: no pixel is positive, a raw intensity image was expected. Is its intensity `log`?")
    smooth = cv2.GaussianBlur(raw.float().numpy(), (0, 0), _SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
    open_beam = smooth.max() if field is None else smooth[field.numpy()].max()
    return math.log(float(open_beam)) - raw.float().clamp_min(positive.min().item()).log()


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
    if not natural(attenuation):
        return downsample(attenuation, factor)
    return -downsample((-attenuation).clamp(-_EXTREME, _EXTREME).exp(), factor).log()
