"""Bones and landmarks from a CT alone."""

from femoreg_torch.segment.bones import Segmentation, segment_bones, segment_bones_without_network
from femoreg_torch.segment.heads import Head, doubted_radius, doubted_slices, head_of
from femoreg_torch.segment.network import BoneNetwork, load_bone_network
from femoreg_torch.segment.points import Proposal, propose_landmarks

__all__ = [
    "BoneNetwork",
    "Head",
    "Proposal",
    "Segmentation",
    "doubted_radius",
    "doubted_slices",
    "head_of",
    "load_bone_network",
    "propose_landmarks",
    "segment_bones",
    "segment_bones_without_network",
]
