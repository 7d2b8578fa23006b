"""The six images of one procedure: every view without and with the device."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.drr import CPU
from femoreg_torch.geometry import Camera, invert_rigid
from femoreg_torch.volume import Volume
from sim.physics.fluoroscopy import XrayModel, fluoroscopy
from sim.physics.line_integrals import areal_solids, together
from sim.theatre.field_of_view import field_of_view
from sim.theatre.metal import Metal
from sim.theatre.posed_tissue import PosedTissue, areal_posed_tissue, take_apart
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
    metal: Metal,
    procedure: Procedure,
    camera: Camera,
    settings: Acquisition,
    model: XrayModel,
    generator: torch.Generator,
    report: Callable[[str], None],
    device: torch.device = CPU,
) -> list[ViewImages]:
    """Images of all views of a procedure; `report` is told each step before it starts.

    Line integrals and the attenuation of the beam are computed on `device`. Noise and detector are on the CPU, so that
    a seed draws the same numbers everywhere.

    `ct` is in HU, `labels` on the same grid; `femur` holds the ids of the operated femur and `head_centre` (3,) is
    its head in LPS mm.
    """
    report("turning the femur")
    tissue = posed_tissue(ct, labels, femur, head_centre, procedure, camera).to(device)
    del ct, labels

    def body(pose: Tensor) -> dict[str, Tensor]:
        return areal_posed_tissue(tissue, pose, camera, settings.step_mm)

    return view_images(body, metal, procedure, camera, model, generator, report)


def posed_tissue(
    ct: Volume,
    labels: Volume,
    femur: tuple[int, ...],
    head_centre: Tensor,
    procedure: Procedure,
    camera: Camera,
    apart: Sequence[tuple[int, ...]] = (),
) -> PosedTissue:
    """The part of a patient that the views of a procedure show, after the femur has turned; see `simulate_images`.

    `apart` is as in `take_apart`.
    """
    poses = procedure.camera_from_pelvis
    ct, labels = (field_of_view(volume, poses, camera, _ROOM_MM) for volume in (ct, labels))
    return take_apart(ct, labels, femur, procedure.femur_rotation, head_centre, apart)


def view_images(
    body: Callable[[Tensor], Mapping[str, Tensor]],
    metal: Metal,
    procedure: Procedure,
    camera: Camera,
    model: XrayModel,
    generator: torch.Generator,
    report: Callable[[str], None],
    on_device: Callable[[Tensor], Mapping[str, Tensor]] | None = None,
) -> list[ViewImages]:
    """Images of all views of a procedure.

    `body` tells the patient's mass per area (H, W) in g/cm² of each material, seen from a pose `camera_from_lps`
    (4, 4), and `on_device`, if given, that of what is fixed to the device, from `camera_from_device`. `report` is told
    each view before it starts.
    """
    poses = procedure.camera_from_pelvis
    camera_from_camera1 = poses @ invert_rigid(poses[0])
    views = []
    for number, pose in enumerate(poses):
        report(f"imaging view {number + 1} of {len(poses)}")
        still = body(pose)
        where = next(iter(still.values())).device
        table = areal_solids(metal.table, camera_from_camera1[number], camera, where)
        device = areal_solids(metal.device, procedure.camera_from_device[number], camera, where)
        if on_device is not None:
            device = together(device, on_device(procedure.camera_from_device[number]))
        later = still if procedure.lps_moved is None else body(pose @ procedure.lps_moved)
        anatomy_image = fluoroscopy(together(still, table), camera, model, generator)
        device_image = fluoroscopy(together(later, table, device), camera, model, generator)
        views.append(ViewImages(anatomy_image, device_image))
    return views
