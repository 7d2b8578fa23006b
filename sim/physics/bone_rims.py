"""How opaque bones are laid over soft tissue: all of their label, and less and less of its partial-volume rim."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.smoothing import gaussian_filter

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Matrix = NDArray[np.floating[Any]]

RIM_MM = 1.2  # width of the blur that grows a label by its partial-volume rim


def bone_opacities(moving: Mask, resting: Mask, spacing_zyx: Matrix) -> tuple[Array, Array]:
    """Opacities in [0, 1] of the moving and the resting bones: 1 on label and rim; rims go to the nearer bone.

    The masks are [z, y, x], as is `spacing_zyx` in mm.
    """
    near_moving, near_resting = (
        gaussian_filter(mask.astype(np.float32), RIM_MM / spacing_zyx, truncate=3) for mask in (moving, resting)
    )

    def opacity(mask: Mask, own: Array, foreign: Array) -> Array:
        alpha = np.clip(own / np.float32(0.15), 0, 1)  # 1 out to one rim width from a flat face, 0 at three
        alpha[own < foreign] = 0
        alpha[mask] = 1
        return alpha

    moving_alpha = opacity(moving, near_moving, near_resting)
    resting_alpha = opacity(resting, near_resting, near_moving)
    moving_alpha[resting] = 0
    resting_alpha[moving] = 0
    return moving_alpha, resting_alpha
