"""How well images fit another one wherever they are shifted: correlation of their gradients."""

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.similarity.kernels import derivative_taps, image_gradients

_SMOOTHING_PX = 1.0
_AROUND_PX = 7  # gradients are divided by their root mean square so far around, so that faint edges count as well
_FLOOR = 0.02  # of the mean square over the image, added to that of the surroundings: noise in plain areas stays small


def shift_correlation(gradients: np.ndarray, fixed: Tensor, field: Tensor | None, most: tuple[int, int]) -> Tensor:
    """Normalised correlation (N, 2 R + 1, 2 C + 1) of the gradients of shifted images and of a fixed one.

    The images are told by their `even_gradients` (N, H, W, 2), the fixed one is (H, W). `most` is the largest shift,
    (R, C) rows and columns. An image moved by r rows and c columns has its correlation, between −1 and 1, at
    [R + r, C + c]. Outside `field` (H, W), bool, the fixed image is not known. Gradients are weighted as in orientation
    correlation (Fitch et al., Proc. BMVC 2002), by what is around them instead of each by itself. Sums are those of
    `cv2.matchTemplate`, on the CPU.
    """
    known = torch.ones_like(fixed) if field is None else field.to(fixed)
    rows, columns = most
    room = (rows, rows, columns, columns)
    looked_in = cv2.copyMakeBorder(even_gradients(fixed[None], known)[0], *room, cv2.BORDER_CONSTANT, value=[0.0, 0.0])
    found = [cv2.matchTemplate(looked_in, image, cv2.TM_CCORR_NORMED) for image in gradients]
    return torch.from_numpy(np.stack(found))


def even_gradients(images: Tensor, known: Tensor | None = None) -> np.ndarray:
    """Gradients (N, H, W, 2) of images (N, H, W), of about equal size everywhere.

    Zero where an image is not `known` (H, W), 1 where it is; everywhere if that is None.
    """
    gradients = image_gradients(images, derivative_taps(_SMOOTHING_PX, images.device))
    power = gradients.square().sum(1, keepdim=True)
    around = F.avg_pool2d(power, 2 * _AROUND_PX + 1, 1, _AROUND_PX, count_include_pad=False)
    weighted = gradients / (around + _FLOOR * power.mean((1, 2, 3), keepdim=True) + 1e-20).sqrt()
    weighted = weighted if known is None else weighted * known
    return weighted.permute(0, 2, 3, 1).contiguous().cpu().numpy()
