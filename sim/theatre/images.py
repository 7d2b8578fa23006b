"""The six images of one procedure: every view without and with the device."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from femoreg_torch.geometry import Camera
from femoreg_torch.volume import Volume
from sim.physics.fluoroscopy import XrayModel, fluoroscopy
from sim.physics.line_integrals import areal_densities, device_density
from sim.theatre.field_of_view import field_of_view
from sim.theatre.posed_tissue import areal_posed_tissue, take_apart
from sim.theatre.procedure import Procedure
from sim.theatre.settings import Acquisition

_ROOM_MM = 45.0  # kept around the field of view, because the femur's turn brings tissue in from outside


@dataclass(frozen=True)
class ViewImages:
    """Raw images (H, W) uint16 of one view."""

    anatomy: Tensor
    device: Tensor


def simulate_images(
    ct: Volume,
    labels: Volume,
    femur: tuple[int, ...],
    head_centre: Tensor,
    mesh: trimesh.Trimesh,
    procedure: Procedure,
    camera: Camera,
    settings: Acquisition,
    model: XrayModel,
    generator: torch.Generator,
    report: Callable[[str], None],
) -> list[ViewImages]:
    """Images of all views of a procedure; `report` is told each step before it starts.

    `ct` is in HU, `labels` on the same grid; `femur` holds the ids of the operated femur and `head_centre` (3,) is
    its head in LPS mm; `mesh` is the device in CAD mm.
    """
    poses = procedure.camera_from_pelvis
    report("turning the femur")
    ct, labels = (field_of_view(volume, poses, camera, _ROOM_MM) for volume in (ct, labels))
    tissue = take_apart(ct, labels, femur, procedure.femur_rotation, head_centre)
    del ct, labels
    metal = device_density(mesh, settings.step_mm, settings.device_hu)
    views = []
    for number, (pose, device_pose) in enumerate(zip(poses, procedure.camera_from_device, strict=True), 1):
        report(f"imaging view {number} of {len(poses)}")
        body = areal_posed_tissue(tissue, pose, camera, settings.step_mm)
        device = areal_densities({"titanium": metal}, device_pose, camera, settings.step_mm)
        anatomy_image = fluoroscopy(body, camera, model, generator)
        views.append(ViewImages(anatomy_image, fluoroscopy(body | device, camera, model, generator)))
    return views
