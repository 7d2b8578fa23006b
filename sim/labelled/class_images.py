"""Which bone each pixel of a labelled image shows: the classes of the network's segmentation."""

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.geometry import transform_points

_SEEN_MM = 1.5  # a bone is labelled where the ray runs through more than this of it
_LEFT, _RIGHT = (
    [HIP.landmark_names.index(name) for name in HIP.landmarks_of(f"hip_{side}", f"femur_{side}")]
    for side in ("left", "right")
)


def class_image(lengths_mm: Tensor, left_hip_is_nearer: bool) -> Tensor:
    """Classes (H, W) uint8 from the path lengths (B, H, W) of each ray in each bone, in the order of the anatomy's.

    Where bones overlap: left femur, right femur, the nearer hip bone, the other one, vertebrae, sacrum, which is the
    order of the DeepFluoro labels (Grupp et al., IJCARS 15, 2020).
    """
    hips = ("hip_right", "hip_left") if left_hip_is_nearer else ("hip_left", "hip_right")
    classes = torch.zeros(lengths_mm.shape[1:], dtype=torch.uint8)
    for number in HIP.classes(("sacrum", "vertebrae", *hips, "femur_right", "femur_left")):  # the last one wins
        classes[lengths_mm[number - 1] > _SEEN_MM] = number
    return classes


def left_is_nearer(landmarks: Tensor, camera_from_lps: Tensor) -> bool:
    """Whether the left half of the pelvis lies nearer to the source, by the middles of its landmarks (L, 3), LPS mm."""
    depth = transform_points(camera_from_lps, landmarks)[:, 2]
    return bool(depth[_LEFT].mean() < depth[_RIGHT].mean())
