"""Labelled views for training: line integrals of soft tissue and of every bone, labels and landmarks.

What is stored is not an image but its layers, so that bone density, soft tissue, noise and instruments can be drawn
anew each time a view is used. There is one file (safetensors) per patient; for its N views it holds:

    tissue     (N, 96, 96) float16         line integral of everything but bone
    bones      (N, B, 192, 192) float16    line integral of bone above soft tissue, in the order of the anatomy's bones
    labels     (N, 96, 96) uint8           class of the bone that is seen; 0 background
    landmarks  (N, L, 2) float32           (column, row) on the 192 × 192 grid, also outside of the image
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.drr import project
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.tensors import write_tensors
from femoreg_torch.volume import Volume
from sim.labelled.attenuation_layers import Layers
from sim.labelled.class_images import class_image, left_is_nearer
from sim.labelled.view_poses import LabelledPose, ViewRanges, sample_pose

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
    bones = torch.zeros((len(HIP.bones), *camera.shape))
    lengths = torch.zeros((len(HIP.bones), *coarse.shape))
    for n, name in enumerate(HIP.bone_names):
        if name in layers.bones:
            camera_from_bone = pose.camera_from(name)
            bones[n] = _line_integral(layers.bones[name], camera_from_bone, camera, _STEP_MM)
            lengths[n] = _line_integral(layers.masks[name], camera_from_bone, coarse, _STEP_MM)
    labels = class_image(lengths, left_is_nearer(layers.landmarks, pose.camera_from_lps))
    landmarks = project_points(camera, transform_points(pose.camera_from_lps, layers.landmarks)).float()
    if pose.mirrored:
        tissue, bones, labels = tissue.flip(-1), bones.flip(-1), labels.flip(-1)
        landmarks[:, 0] = camera.shape[1] - 1 - landmarks[:, 0]
    return LabelledView(tissue, bones, labels, landmarks)


def _line_integral(volume: Volume, camera_from_volume: Tensor, camera: Camera, step_mm: float) -> Tensor:
    return project([volume], camera_from_volume[None, None], camera, step_mm)[0]


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
        write_tensors(part, content, {"source": source})
