"""Robust pose of an object from its landmarks in one image, a likely one from few, and exact ones from three points."""

from femoreg_torch.pnp.likely import likely_pose
from femoreg_torch.pnp.minimal import refined_pose, three_point_poses
from femoreg_torch.pnp.solve import FRONT_TO_BACK, MINIMUM, MIRRORED_ADVICE, PnpResult, solve_pnp

__all__ = [
    "FRONT_TO_BACK",
    "MINIMUM",
    "MIRRORED_ADVICE",
    "PnpResult",
    "likely_pose",
    "refined_pose",
    "solve_pnp",
    "three_point_poses",
]
