"""Linear attenuation from Hounsfield units, and that of single bones as a registration renders them."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.labels import Corner, label_box
from femoreg_torch.volume.resample import crop

# Attenuation of one HU in 1/mm: (µ water − µ air) / 1000 with 0.02683 and 0.02485e-4 1/mm, as in xReg,
# lib/image/xregHUToLinAtt.cpp (rg2/xreg).
_PER_HU = 2.6828e-5
_MARGIN = 2  # voxels of zero kept around a structure, so that trilinear interpolation fades out inside the crop


def hu_to_attenuation(hu: Tensor, offset_hu: float) -> Tensor:
    """Linear attenuation max(0, HU − offset) · 2.6828e-5 in 1/mm; with an offset of −1000, water has 0.0268/mm."""
    return (hu - offset_hu).mul_(_PER_HU).clamp_min_(0)


def _grown(box: tuple[Corner, Corner], margin: int) -> tuple[Corner, Corner]:
    (x0, y0, z0), (x1, y1, z1) = box
    return (x0 - margin, y0 - margin, z0 - margin), (x1 + margin, y1 + margin, z1 + margin)


def _dilated(mask: NDArray[np.bool_], allowed: NDArray[np.bool_], times: int) -> NDArray[np.bool_]:
    """A mask (Z, Y, X) grown so many times to the neighbours across faces that are allowed, and hold the mask itself.

    As `scipy.ndimage.binary_dilation` does with a mask, which takes seven times as long.
    """
    for _ in range(times):
        grown = mask.copy()
        for axis in range(3):
            to, of = grown.swapaxes(0, axis), mask.swapaxes(0, axis)
            to[1:] |= of[:-1]
            to[:-1] |= of[1:]
        mask = grown & allowed
    return mask


def structure_attenuation(
    ct: Volume, labels: Volume, ids: Sequence[int], grow_voxels: int = 2, offset_hu: float = 50.0
) -> Volume:
    """Attenuation of the bone with these label `ids`, 1/mm above `offset_hu`, zero elsewhere; cropped with its affine.

    The mask is grown by `grow_voxels` (not into other labels) so that the partial-volume rim of the bone is kept: a
    hard label edge renders the bone too small, and a registration then brings it closer to the source. HU are taken
    from `ct`, on the same grid as `labels`. Raises `InputError` if no voxel carries the labels, or none of them is
    above the offset.
    """
    lo, hi = _grown(label_box(labels, ids), grow_voxels + _MARGIN)
    part, label = crop(ct, lo, hi), crop(labels, lo, hi).data.numpy()
    mask = np.isin(label, list(ids))
    if grow_voxels:
        mask = _dilated(mask, mask | (label == 0), grow_voxels)
    attenuation = hu_to_attenuation(part.data, offset_hu).mul_(torch.from_numpy(mask))
    if not attenuation.any():
        raise InputError(
            f"CT: nothing within the labels {list(ids)} is above {offset_hu:g} HU. Is the label map of this CT?"
        )
    content = label_box(part.with_data((attenuation > 0).byte()), [1])
    return crop(part.with_data(attenuation), *_grown(content, _MARGIN))
