"""Labelled fluoroscopy at full physics strength: images, labels, landmarks and true poses of one patient.

There is one file (safetensors) per patient; for its N views, as the source sees them, it holds:

    images             (N, H, W) uint16          raw counts, bone dark
    labels             (N, H / 2, W / 2) uint8   class of the bone that is seen; 0 background
    landmarks          (N, L, 2) float32         (column, row) in the image, also outside of it
    landmarks_lps      (L, 3) float64            the same in space, mm
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
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import case_folder
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera, carm_from_dict, load_carm
from femoreg_torch.tensors import check_shapes, read_metadata, read_tensors, write_tensors
from femoreg_torch.text import json_content
from femoreg_torch.volume import resample_isotropic
from sim.labelled.devices_in_view import make_devices
from sim.labelled.imaged_patient import ImagedPatient, read_imaged_patient
from sim.labelled.physics_views import render_physics
from sim.labelled.settings import LabelledSettings, load_labelled_settings
from sim.labelled.view_poses import FEMORAL_HEADS
from sim.physics.fluoroscopy import XrayModel

_HIPS_MM = 2.5  # voxels of the hip bones that are kept with the images
_TENSORS: dict[str, tuple[str | int, ...]] = {  # and their shapes
    "images": ("N", "H", "W"),
    "labels": ("N", "h", "w"),
    "landmarks": ("N", len(HIP.landmarks), 2),
    "landmarks_lps": (len(HIP.landmarks), 3),
    "camera_from_lps": ("N", 4, 4),
    "camera_from_femur": ("N", 2, 4, 4),
    "device": ("N",),
    "one_hip": ("N",),
    "hips": ("D", "E", "F"),
    "lps_from_hips": (4, 4),
    "xray": ("N", "K"),
}


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
    patient: ImagedPatient, settings: LabelledSettings, count: int, seed: int, source: str
) -> LabelledImages:
    """`count` random views of one patient, on the detector of the C-arm binned as `settings` say.

    Views are rigid, so that one pose tells all: raises `InputError` unless the size and stretch of the views are 0.
    """
    if settings.views.size or settings.views.stretch:
        raise InputError("labelled images: size and stretch of `views` must be 0.")
    camera = load_carm(settings.carm).camera.downsampled(settings.image.binning)
    rng, noise = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    devices = make_devices(settings)
    views = [
        render_physics(patient, settings, camera, camera.downsampled(2), devices, rng, noise) for _ in range(count)
    ]
    left, right = patient.masks["hip_left"], patient.masks["hip_right"]
    hips = resample_isotropic(left.with_data(left.data + right.data), _HIPS_MM)
    return LabelledImages(
        images=torch.stack([view.image for view in views]),
        labels=torch.stack([view.labels for view in views]),
        landmarks=torch.stack([view.landmarks for view in views]),
        landmarks_lps=patient.landmarks,
        camera_from_lps=torch.stack([view.pose.camera_from_lps for view in views]),
        camera_from_femur=torch.stack(
            [torch.stack([view.pose.camera_from(femur) for femur in FEMORAL_HEADS]) for view in views]
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


def write_labelled_images(folder: Path, out: Path, config: str, count: int, seed: int, source: str | None) -> None:
    """Render `count` views of the patient in `folder` (see `sim.labelled.patient_folders`) into the file `out`.

    `config` is a preset of `configs/simulation` or a YAML file; `source` says who it is, else the folder's name does.
    Raises `InputError` for input that does not fit.
    """
    settings = load_labelled_settings(config)
    if count < 1:
        raise InputError(f"labelled images: a count of 1 or more was expected, got {count}.")
    folder = case_folder(folder)
    patient = read_imaged_patient(folder)
    write_labelled(out, render_views(patient, settings, count, seed, source or folder.resolve().name))


def write_labelled(path: Path, content: LabelledImages) -> None:
    """Write the labelled images of one patient, whole or not at all."""
    metadata = {
        "source": content.source,
        "camera": json.dumps(asdict(content.camera)),
        "xray": json.dumps(content.xray_names),
    }
    with temporary_file(path) as part:
        write_tensors(part, {name: getattr(content, name).contiguous() for name in _TENSORS}, metadata)


def read_labelled(path: Path) -> LabelledImages:
    """What `write_labelled` wrote. Raises `InputError` if there is no such file, or it is something else."""
    metadata = read_metadata(path)
    if not {"source", "camera", "xray"} <= set(metadata):
        raise InputError(f"{path}: does not hold labelled images; make them with `femoreg labelled-images`.")
    _, tensors = read_tensors(path, tuple(_TENSORS))
    check_shapes(tensors, _TENSORS, str(path))
    camera = carm_from_dict(json_content(metadata["camera"], f"{path}, camera"), f"{path}, camera").camera
    if tuple(tensors["images"].shape[1:]) != camera.shape or tensors["images"].dtype != torch.uint16:
        raise InputError(f"{path}, images: 16-bit images of the camera's {camera.shape} pixels were expected.")
    for name in ("camera_from_lps", "lps_from_hips"):
        if tensors[name].dtype != torch.float64:
            raise InputError(f"{path}, {name}: float64 was expected, found {tensors[name].dtype}.")
    return LabelledImages(
        **tensors,
        xray_names=tuple(json_content(metadata["xray"], f"{path}, xray")),
        camera=camera,
        source=metadata["source"],
    )
