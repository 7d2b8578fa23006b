"""One labelled view of a patient at full physics strength: image, labels, landmarks and true pose.

Made to measure a landmark detector: `sim.labelled.training_views` and the augmentation of `training` know nothing of
this chain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, project_points, transform_points
from sim.labelled.class_images import class_image, left_is_nearer
from sim.labelled.devices_in_view import PosableDevice, device_pose
from sim.labelled.imaged_patient import MASK_MM, ImagedPatient
from sim.labelled.settings import LabelledSettings
from sim.labelled.view_poses import LabelledPose, sample_pose
from sim.physics.fluoroscopy import XrayModel, fluoroscopy
from sim.physics.line_integrals import areal_densities, areal_tissue


@dataclass(frozen=True)
class PhysicsView:
    """One view, as the camera sees it."""

    image: Tensor  # (H, W) uint16, raw counts, bone dark
    labels: Tensor  # (h, w) uint8, classes of bones
    landmarks: Tensor  # (L, 2) float32, column and row, also outside of the image
    pose: LabelledPose
    has_device: bool
    one_hip: bool
    model: XrayModel


def _render_labels(patient: ImagedPatient, pose: LabelledPose, camera: Camera) -> Tensor:
    """Classes (H, W) uint8 on the grid of `camera`."""
    lengths = torch.zeros((len(HIP.bones), *camera.shape))
    for n, name in enumerate(HIP.bone_names):
        if name in patient.masks:
            camera_from_mask = pose.camera_from(name)[None, None]
            lengths[n] = project([patient.masks[name]], camera_from_mask, camera, MASK_MM)[0]
    return class_image(lengths, left_is_nearer(patient.landmarks, pose.camera_from_lps))


def _render_tissue(patient: ImagedPatient, pose: LabelledPose, camera: Camera, step_mm: float) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of water and bone. Soft tissue stays where it is when a femur turns."""
    poses = torch.stack([pose.camera_from_lps, *(pose.camera_from(femur) for femur in patient.femora)])
    bones = [patient.bone, *patient.femora.values()]
    return areal_tissue(patient.filled, pose.camera_from_lps, bones, poses, camera, step_mm)


def render_physics(
    patient: ImagedPatient,
    settings: LabelledSettings,
    camera: Camera,
    labels_camera: Camera,
    devices: Sequence[PosableDevice],
    rng: np.random.Generator,
    noise: torch.Generator,
) -> PhysicsView:
    """A random view of a patient, its labels on the grid of another camera; `rng` draws all but the noise."""
    one_hip = bool(rng.random() < settings.views.one_hip_share)
    pose = sample_pose(replace(settings.views, one_hip_share=float(one_hip)), patient.landmarks, rng)
    model = settings.xray.draw(rng)
    areal = _render_tissue(patient, pose, camera, settings.image.step_mm)
    has_device = bool(rng.random() < settings.device.share)
    if has_device:
        device = devices[int(rng.integers(len(devices)))]
        camera_from_device = device_pose(device.mesh, device.points, settings.device, rng)
        areal |= areal_densities({"titanium": device.density}, camera_from_device, camera, settings.image.step_mm)
    image = fluoroscopy(areal, camera, model, noise)
    labels = _render_labels(patient, pose, labels_camera)
    landmarks = project_points(camera, transform_points(pose.camera_from_lps, patient.landmarks)).float()
    return PhysicsView(image, labels, landmarks, pose, has_device, one_hip, model)
