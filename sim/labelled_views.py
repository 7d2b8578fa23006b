"""One labelled view of a patient at full physics strength: image, labels, landmarks and true pose.

Made to measure a landmark detector: `sim.dataset` and the augmentation of `training` know nothing of this chain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, about_point, exp_so3, project_points, rigid, transform_points
from femoreg_torch.volume import HIP_LANDMARKS, Volume, resample_isotropic
from sim.acquisition import nominal_device
from sim.dataset import one_label_per_pixel
from sim.device import make_device
from sim.imaging import device_density, shadow
from sim.layers import BONE_IDS
from sim.posed_tissue import separate
from sim.settings import read_settings, record, section
from sim.views import FEMUR_IDS, LabelledPose, ViewRanges, sample_pose
from sim.xray import XrayModel, areal_densities, fluoroscopy

_MASK_MM = 1.5  # voxels and step of the path lengths behind the labels
_BEYOND_MM = 60.0  # of the first and the last slice repeated below and above the scan


@dataclass(frozen=True)
class DeviceRanges:
    """How the device comes into view."""

    share: float  # of the views
    count: int  # different devices
    hu: float
    depth_mm: tuple[float, float]  # source to its middle
    shift_mm: float  # of its middle from the central ray, across and along
    angle_deg: float  # out of the plane of the detector; in that plane it points anywhere


@dataclass(frozen=True)
class LabelledSettings:
    """Settings of labelled images; their meaning is told in `configs/simulation/labelled.yaml`."""

    views: ViewRanges
    device: DeviceRanges
    binning: int
    step_mm: float
    xray: dict[str, float | tuple[float, float]]


@dataclass(frozen=True)
class Anatomy:
    """A patient ready for imaging: densities in g/cm³ and masks, all where the CT has them."""

    filled: Volume
    bone: Volume  # but for the femora
    femora: dict[int, Volume]  # label → density
    masks: dict[int, Volume]  # label → 1 inside the bone; a label that the CT lacks is absent
    landmarks: Tensor  # (14, 3) LPS mm


@dataclass(frozen=True)
class PhysicsView:
    """One view; where it is mirrored, image, labels and landmarks are as displayed, the pose as the camera sees it."""

    image: Tensor  # (H, W) uint16, raw counts, bone dark
    labels: Tensor  # (h, w) uint8
    landmarks: Tensor  # (14, 2) float32, column and row, also outside of the image
    pose: LabelledPose
    has_device: bool
    one_hip: bool
    model: XrayModel


def load_labelled_settings(config: str) -> LabelledSettings:
    """Settings of a preset in `configs/simulation/` or of a YAML file. Raises `InputError` that names the key."""
    return labelled_settings(read_settings(config), f"labelled images {config}")


def labelled_settings(settings: dict[str, Any], where: str) -> LabelledSettings:
    """Settings from the sections `views`, `device`, `image` and `xray`; other sections are left alone."""
    image = section(settings, "image", where)
    if set(image) != {"binning", "step_mm"}:
        raise InputError(f"{where}, image: `binning` and `step_mm` were expected, found {', '.join(sorted(image))}.")
    xray = {name: _range(value) for name, value in section(settings, "xray", where).items()}
    record(XrayModel, xray, f"{where}, xray")
    return LabelledSettings(
        record(ViewRanges, _ranges(section(settings, "views", where)), f"{where}, views"),
        record(DeviceRanges, _ranges(section(settings, "device", where)), f"{where}, device"),
        image["binning"],
        image["step_mm"],
        xray,
    )


def _range(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _ranges(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _range(value) for name, value in values.items()}


def draw_model(xray: Mapping[str, float | tuple[float, float]], rng: np.random.Generator) -> XrayModel:
    """Tube and detector with every [low, high] of `xray` replaced by a draw: uniform, but for the dose, log-uniform."""
    drawn: dict[str, Any] = {}
    for name, value in xray.items():
        if not isinstance(value, tuple):
            drawn[name] = value
        elif name == "dose_ugy":
            drawn[name] = float(np.exp(rng.uniform(*np.log(value))))
        else:
            drawn[name] = float(rng.uniform(*value))
    return XrayModel(**drawn)


def prepare_anatomy(ct: Volume, labels: Volume, landmarks: Mapping[str, Tensor]) -> Anatomy:
    """The patient of a CT in HU and its label map on the same grid, with both femora apart.

    Raises `InputError` if the label map lacks a femur.
    """
    ct, labels = _prolonged(ct), _prolonged(labels)
    filled, bone, femora, _ = separate(ct, labels, [(label,) for label in FEMUR_IDS])
    masks = {}
    for label in BONE_IDS:
        inside = labels.data == label
        if inside.any():
            masks[label] = resample_isotropic(labels.with_data(inside.to(torch.float32)), _MASK_MM)
    points = torch.stack([landmarks[name] for name in HIP_LANDMARKS])
    return Anatomy(filled, bone, dict(zip(FEMUR_IDS, femora, strict=True)), masks, points)


def _prolonged(volume: Volume) -> Volume:
    """The volume with its first and last slice repeated: a patient does not end where the CT ends."""
    slices = round(_BEYOND_MM / volume.spacing_mm[2])
    data = volume.data
    data = torch.cat([data[:1].expand(slices, -1, -1), data, data[-1:].expand(slices, -1, -1)])
    affine = volume.lps_from_index.clone()
    affine[:3, 3] -= slices * affine[:3, 2]
    return Volume(data, affine)


def render_labels(anatomy: Anatomy, pose: LabelledPose, camera: Camera) -> Tensor:
    """Labels (H, W) uint8 on the grid of `camera`."""
    lengths = torch.zeros((len(BONE_IDS), *camera.shape))
    for n, label in enumerate(BONE_IDS):
        if label in anatomy.masks:
            camera_from_mask = pose.camera_from(label)[None, None]
            lengths[n] = project([anatomy.masks[label]], camera_from_mask, camera, _MASK_MM)[0]
    depth = transform_points(pose.camera_from_lps, anatomy.landmarks)[:, 2]  # left and right take turns
    return one_label_per_pixel(lengths, bool(depth[0::2].mean() < depth[1::2].mean()))


def render_tissue(anatomy: Anatomy, pose: LabelledPose, camera: Camera, step_mm: float) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of water and bone. Soft tissue stays where it is when a femur turns."""
    poses = torch.stack([pose.camera_from_lps, *(pose.camera_from(label) for label in anatomy.femora)])
    bones = [anatomy.bone, *anatomy.femora.values()]
    return shadow(anatomy.filled, pose.camera_from_lps, bones, poses, camera, step_mm)


@dataclass(frozen=True)
class PosableDevice:
    """A device that can be brought into view."""

    density: Volume
    mesh: trimesh.Trimesh
    points: dict[str, Tensor]


def make_devices(settings: LabelledSettings) -> list[PosableDevice]:
    """The devices of the first seeds."""
    made = [make_device(seed) for seed in range(settings.device.count)]
    return [
        PosableDevice(device_density(mesh, settings.step_mm, settings.device.hu), mesh, points) for mesh, points in made
    ]


def render_physics(
    anatomy: Anatomy,
    settings: LabelledSettings,
    camera: Camera,
    labels_camera: Camera,
    devices: Sequence[PosableDevice],
    rng: np.random.Generator,
    noise: torch.Generator,
) -> PhysicsView:
    """A random view of a patient, its labels on the grid of another camera; `rng` draws all but the noise."""
    one_hip = bool(rng.random() < settings.views.one_hip_share)
    pose = sample_pose(replace(settings.views, one_hip_share=float(one_hip)), anatomy.landmarks, rng)
    model = draw_model(settings.xray, rng)
    areal = render_tissue(anatomy, pose, camera, settings.step_mm)
    has_device = bool(rng.random() < settings.device.share)
    if has_device:
        device = devices[int(rng.integers(len(devices)))]
        camera_from_device = device_pose(device.mesh, device.points, settings.device, rng)
        areal |= areal_densities({"titanium": device.density}, camera_from_device, camera, settings.step_mm)
    image = fluoroscopy(areal, camera, model, noise)
    labels = render_labels(anatomy, pose, labels_camera)
    landmarks = project_points(camera, transform_points(pose.camera_from_lps, anatomy.landmarks)).float()
    if pose.mirrored:
        image, labels = image.flip(-1), labels.flip(-1)
        landmarks[:, 0] = camera.shape[1] - 1 - landmarks[:, 0]
    return PhysicsView(image, labels, landmarks, pose, has_device, one_hip, model)


def device_pose(
    mesh: trimesh.Trimesh, points: dict[str, Tensor], ranges: DeviceRanges, rng: np.random.Generator
) -> Tensor:
    """Pose (4, 4): the guide in any direction across the image, then leaning and moved aside."""
    direction = rng.uniform(0, 2 * np.pi)
    across = torch.tensor([np.cos(direction), np.sin(direction), 0.0], dtype=torch.float64)
    depth = rng.uniform(*ranges.depth_mm)
    nominal = nominal_device(mesh, points, across, depth)
    axis = F.normalize(torch.from_numpy(rng.standard_normal(3)), dim=0)
    angle = np.radians(rng.uniform(-ranges.angle_deg, ranges.angle_deg))
    middle = torch.tensor([0.0, 0.0, depth], dtype=torch.float64)
    shift = torch.tensor([*rng.uniform(-ranges.shift_mm, ranges.shift_mm, 2), 0.0], dtype=torch.float64)
    return rigid(translation=shift) @ about_point(rigid(exp_so3(angle * axis)), middle) @ nominal
