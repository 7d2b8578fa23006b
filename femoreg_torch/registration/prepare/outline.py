"""The outlines of bones that start poses are compared by."""

import numpy as np
import torch

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.registration.scene import Outline
from femoreg_torch.volume import BoneLabels, looked_up, resample_isotropic

OUTLINE_SPACING_MM = 2.5  # of the mask


def outline_of(bones: BoneLabels, anatomy: Anatomy | None) -> Outline | None:
    """Those bones of a label map that the anatomy compares outlines by, on coarse voxels.

    None where the map tells none of them apart from others: a pelvis in one label cannot be compared with a
    segmentation that tells hip bones and sacrum apart.
    """
    told = tuple(bone for bone in anatomy.outline if bone in bones.ids) if anatomy else ()
    if not told:
        return None
    wanted = np.zeros(256, np.float32)
    wanted[list(bones.of(told, anatomy))] = 1
    inside = torch.from_numpy(looked_up(wanted, bones.labels.data.numpy()))
    return Outline(resample_isotropic(bones.labels.with_data(inside), OUTLINE_SPACING_MM), told)
