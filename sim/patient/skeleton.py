"""All bones of one patient, as distance fields."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.anatomy import label_table
from sim.patient.distance_field import Field

Points = NDArray[np.float64]

LABEL_IDS = {bone: ids[0] for bone, ids in label_table("femoreg").items()}  # in the label maps that are written
SIDES = {"left": 1, "right": -1}  # the sign of x


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones as fields in LPS mm with the origin midway between the femoral heads.

    `lps_from_pelvis` (3, 3) turns the anterior pelvic plane's frame; `lps_from_femur` (3, 3) per side turns the femoral
    frame (z up the shaft) about the head; `neck` per side is the unit vector from the head's centre along the neck.
    """

    bones: dict[str, Field]
    heads: dict[str, Points]
    head_radius: float
    lps_from_pelvis: Points
    lps_from_femur: dict[str, Points]
    neck: dict[str, Points]
