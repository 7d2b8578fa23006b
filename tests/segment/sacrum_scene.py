"""A sacrum of simple solids with two foramina, beside an ilium, whose true labels are known."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.anatomy import HIP
from femoreg_torch.volume import Volume, axis_aligned

SACRUM, ILIUM = 1 + HIP.bone_names.index("sacrum"), 1 + HIP.bone_names.index("hip_left")
WING_MM = 62.0  # left face of the sacrum; the joint is 3 mm wide
_SHAPE = (72, 66, 96)  # voxels of 1 mm along z, y, x
_CORTEX_MM = 2.0


def sacrum_scene() -> tuple[Volume, NDArray[np.uint8], NDArray[np.bool_]]:
    """CT in HU, its true labels, and the foramina, (Z, Y, X) each.

    Cortex of 600 HU, 2 mm thick, around marrow of 90 HU, in tissue of 50 HU. The foramina are 10 mm wide and run from
    the front of the sacrum to its back, with cortex around.
    """
    z, y, x = np.mgrid[: _SHAPE[0], : _SHAPE[1], : _SHAPE[2]].astype(float)
    block = np.maximum.reduce([10 - x, x - WING_MM, 20 - y, y - 46, 10 - z, z - 62])
    tubes = np.minimum(np.hypot(x - 28, z - 24), np.hypot(x - 28, z - 46)) - 5
    sacrum = np.maximum(block, -tubes)
    ilium = np.maximum.reduce([WING_MM + 3 - x, x - 85, 8 - y, y - 58, 6 - z, z - 68])
    hu, labels = np.full(_SHAPE, 50.0), np.zeros(_SHAPE, np.uint8)
    for distance, number in ((sacrum, SACRUM), (ilium, ILIUM)):
        hu[distance <= 0] = 600
        hu[distance < -_CORTEX_MM] = 90
        labels[distance <= 0] = number
    hu = ndimage.gaussian_filter(hu, 0.5) + np.random.default_rng(0).normal(0, 15, _SHAPE)
    ct = Volume(torch.from_numpy(hu.astype(np.float32)), axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    return ct, labels, (tubes < 0) & (block <= 0)
