"""Labelled views for training: line integrals of soft tissue and of every bone, labels and landmarks.

What is stored is not an image but its layers, so that bone density, soft tissue, noise and instruments can be drawn
anew each time a view is used. There is one file (safetensors) per patient; for its N views it holds:

    tissue     (N, 96, 96) float16         line integral of everything but bone
    bones      (N, 6, 192, 192) float16    line integral of bone above soft tissue, labels 1 to 6
    labels     (N, 96, 96) uint8           which bone is seen; 0 background
    landmarks  (N, 14, 2) float32          (column, row) on the 192 × 192 grid, also outside of the image
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.volume import Volume
from sim.layers import BONE_IDS, Layers
from sim.views import LabelledPose, ViewRanges, sample_pose

_SEEN_MM = 1.5  # a bone is labelled where the ray runs through more than this of it
_STEP_MM = 1.5
_TISSUE_STEP_MM = 4.0


@dataclass(frozen=True)
class LabelledView:
    """One view; the shapes are those of the file without N."""

    tissue: Tensor
    bones: Tensor
    labels: Tensor
    landmarks: Tensor


def render_view(layers: Layers, pose: LabelledPose, camera: Camera) -> LabelledView:
    """Layers, labels and landmarks of one view on the grid of `camera`; tissue and labels on a grid half as fine."""
    coarse = camera.downsampled(2)
    tissue = _line_integral(layers.tissue, pose.camera_from_lps, coarse, _TISSUE_STEP_MM)
    bones = torch.zeros((len(BONE_IDS), *camera.shape))
    lengths = torch.zeros((len(BONE_IDS), *coarse.shape))
    for n, label in enumerate(BONE_IDS):
        if label in layers.bones:
            camera_from_bone = pose.camera_from(label)
            bones[n] = _line_integral(layers.bones[label], camera_from_bone, camera, _STEP_MM)
            lengths[n] = _line_integral(layers.masks[label], camera_from_bone, coarse, _STEP_MM)
    labels = one_label_per_pixel(lengths, _left_hip_is_nearer(layers, pose))
    landmarks = project_points(camera, transform_points(pose.camera_from_lps, layers.landmarks)).float()
    if pose.mirrored:
        tissue, bones, labels = tissue.flip(-1), bones.flip(-1), labels.flip(-1)
        landmarks[:, 0] = camera.shape[1] - 1 - landmarks[:, 0]
    return LabelledView(tissue, bones, labels, landmarks)


def _line_integral(volume: Volume, camera_from_volume: Tensor, camera: Camera, step_mm: float) -> Tensor:
    return project([volume], camera_from_volume[None, None], camera, step_mm)[0]


def _left_hip_is_nearer(layers: Layers, pose: LabelledPose) -> bool:
    """Whether the left hip bone lies nearer to the source, by the middles of both landmark halves."""
    depth = transform_points(pose.camera_from_lps, layers.landmarks)[:, 2]
    return bool(depth[0::2].mean() < depth[1::2].mean())


def one_label_per_pixel(lengths_mm: Tensor, left_hip_is_nearer: bool) -> Tensor:
    """Labels (H, W) uint8 from the path lengths (6, H, W) of each ray in each bone.

    Where bones overlap: left femur, right femur, the nearer hip bone, the other one, vertebrae, sacrum, which is the
    order of the DeepFluoro labels (Grupp et al., IJCARS 15, 2020).
    """
    hips = (2, 1) if left_hip_is_nearer else (1, 2)
    labels = torch.zeros(lengths_mm.shape[1:], dtype=torch.uint8)
    for label in (4, 3, *hips, 6, 5):  # the last one wins
        labels[lengths_mm[label - 1] > _SEEN_MM] = label
    return labels


def write_views(
    path: Path, layers: Layers, ranges: ViewRanges, camera: Camera, count: int, rng: np.random.Generator, source: str
) -> None:
    """Render `count` random views of one patient into `path`; `source` says in the file's metadata who it is."""
    views = [render_view(layers, sample_pose(ranges, layers.landmarks, rng), camera) for _ in range(count)]
    content = {
        "tissue": torch.stack([view.tissue for view in views]).half(),
        "bones": torch.stack([view.bones for view in views]).half(),
        "labels": torch.stack([view.labels for view in views]),
        "landmarks": torch.stack([view.landmarks for view in views]),
    }
    with temporary_file(path) as part:
        save_file(content, part, metadata={"source": source})
