"""Labelled fluoroscopy at full physics strength: images, labels, landmarks and true poses of one patient.

There is one file (safetensors) per patient; for its N views it holds:

    images             (N, H, W) uint16          raw counts, bone dark
    labels             (N, H / 2, W / 2) uint8   which bone is seen; 0 background
    landmarks          (N, 14, 2) float32        (column, row) in the image, also outside of it
    landmarks_lps      (14, 3) float64           the same in space, mm
    camera_from_lps    (N, 4, 4) float64         pose of tissue and pelvis
    camera_from_femur  (N, 2, 4, 4) float64      of the left and the right femur
    device             (N,) bool                 whether the device is in view
    one_hip            (N,) bool                 whether the view is aimed at one hip
    hips               (D, H, W) uint8           share of a voxel inside the hip bones, 255 for all of it
    lps_from_hips      (4, 4) float64            from that volume's (x, y, z) index to mm
    xray               (N, K) float64            what was drawn for tube and detector; `xray_names` says what
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera
from femoreg_torch.volume import resample_isotropic
from sim.labelled_views import Anatomy, LabelledSettings, make_devices, render_physics
from sim.views import FEMUR_IDS
from sim.xray import XrayModel

_HIPS_MM = 2.5  # voxels of the hip bones that are kept with the images
_TENSORS = (
    "images",
    "labels",
    "landmarks",
    "landmarks_lps",
    "camera_from_lps",
    "camera_from_femur",
    "device",
    "one_hip",
    "hips",
    "lps_from_hips",
    "xray",
)


@dataclass(frozen=True)
class LabelledImages:
    """What a file holds; see above."""

    images: Tensor
    labels: Tensor
    landmarks: Tensor
    landmarks_lps: Tensor
    camera_from_lps: Tensor
    camera_from_femur: Tensor
    device: Tensor
    one_hip: Tensor
    hips: Tensor
    lps_from_hips: Tensor
    xray: Tensor
    xray_names: tuple[str, ...]
    camera: Camera
    source: str


def render_views(
    anatomy: Anatomy, settings: LabelledSettings, camera: Camera, count: int, seed: int, source: str
) -> LabelledImages:
    """`count` random views of one patient, on the grid of `camera` binned as `settings` say.

    Views are rigid and from the front, so that one pose tells all: raises `InputError` unless the size, stretch and
    posterior share of the views are 0.
    """
    if settings.views.size or settings.views.stretch or settings.views.posterior_share:
        raise InputError("labelled images: size, stretch and posterior_share of `views` must be 0.")
    camera = camera.downsampled(settings.binning)
    rng, noise = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    devices = make_devices(settings)
    views = [
        render_physics(anatomy, settings, camera, camera.downsampled(2), devices, rng, noise) for _ in range(count)
    ]
    hips = resample_isotropic(anatomy.masks[1].with_data(anatomy.masks[1].data + anatomy.masks[2].data), _HIPS_MM)
    return LabelledImages(
        images=torch.stack([view.image for view in views]),
        labels=torch.stack([view.labels for view in views]),
        landmarks=torch.stack([view.landmarks for view in views]),
        landmarks_lps=anatomy.landmarks,
        camera_from_lps=torch.stack([view.pose.camera_from_lps for view in views]),
        camera_from_femur=torch.stack(
            [torch.stack([view.pose.camera_from(label) for label in FEMUR_IDS]) for view in views]
        ),
        device=torch.tensor([view.has_device for view in views]),
        one_hip=torch.tensor([view.one_hip for view in views]),
        hips=(255 * hips.data).round().to(torch.uint8),
        lps_from_hips=hips.lps_from_index,
        xray=torch.tensor([list(asdict(view.model).values()) for view in views], dtype=torch.float64),
        xray_names=tuple(XrayModel.__dataclass_fields__),
        camera=camera,
        source=source,
    )


def write_labelled(path: Path, content: LabelledImages) -> None:
    """Write one patient's labelled images."""
    metadata = {
        "source": content.source,
        "camera": json.dumps(asdict(content.camera)),
        "xray": json.dumps(content.xray_names),
    }
    with temporary_file(path) as part:
        save_file({name: getattr(content, name).contiguous() for name in _TENSORS}, part, metadata=metadata)


def read_labelled(path: Path) -> LabelledImages:
    """What `write_labelled` wrote. Raises `InputError` if there is no such file, or it is something else."""
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
        if not {"source", "camera", "xray"} <= set(metadata):
            raise InputError(f"{path}: does not hold labelled images; make them with `sim.labelled_images`.")
        tensors = {name: file.get_tensor(name) for name in _TENSORS}
    known = json.loads(metadata["camera"])
    camera = Camera(known["sdd_mm"], *(tuple(known[key]) for key in ("pixel_mm", "shape", "principal_point_px")))
    return LabelledImages(
        **tensors, xray_names=tuple(json.loads(metadata["xray"])), camera=camera, source=metadata["source"]
    )
