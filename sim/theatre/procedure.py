"""The paper's acquisition (section III-A) as poses: from the nominal AP view, everything that moves at random."""

import math
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.case.femoroplasty import DEVICE, FEMUR, PELVIS
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import (
    CArm,
    Poses,
    about_point,
    exp_so3,
    invert_rigid,
    project_points,
    rigid,
    transform_points,
)
from femoreg_torch.geometry.poses import poses_by_object
from sim.theatre.nominal_poses import nominal_ap
from sim.theatre.preoperative_case import Preoperative
from sim.theatre.settings import Acquisition

_TRIES = 200


@dataclass(frozen=True, eq=False)
class Procedure:
    """One drawn procedure: where everything truly is, and how the femur has turned. All transforms are float64, mm."""

    camera_from_pelvis: Tensor  # (V, 4, 4)
    camera1_from_femur: Tensor  # (4, 4)
    camera_from_device: Tensor  # (V, 4, 4); it may move between the views
    femur_rotation: Tensor  # (3, 3), in LPS about the femoral head centre
    lps_moved: Tensor | None = None  # (4, 4): how the patient has moved before the images with the device

    @property
    def truth(self) -> Poses:
        """The same as a case keeps it."""
        others = {FEMUR: self.camera1_from_femur, DEVICE: self.camera_from_device[0]}
        return poses_by_object(self.camera_from_pelvis, PELVIS, others)


def draw_procedure(
    known: Preoperative, mesh: trimesh.Trimesh, settings: Acquisition, generator: torch.Generator
) -> Procedure:
    """Draw every pose of one procedure.

    The pelvis moves about the point where the central ray passes the depth of the femoral head, each C-arm stop about
    the isocentre, the femur about the centre of its head, the device about its `center` near its nominal pose. The
    device is drawn again until it lies inside all images. Raises `InputError` if it never does.
    """
    carm = known.case.carm
    ap = nominal_ap(known.head, known.side, settings)
    pivot = torch.tensor([0.0, 0.0, settings.head_depth_mm], dtype=torch.float64)
    room_from_pelvis = about_point(settings.pelvis.draw(generator), pivot) @ ap
    camera_from_pelvis = torch.stack([stop @ room_from_pelvis for stop in draw_stops(carm, settings, generator)])

    femur_motion = settings.femur.draw(generator)
    camera1_from_femur = camera_from_pelvis[0] @ about_point(femur_motion, known.head)

    nominal = known.device.start.camera1_from
    assert nominal is not None  # `read_preoperative` put it there
    camera_from_camera1 = camera_from_pelvis @ invert_rigid(camera_from_pelvis[0])
    centre = transform_points(nominal, known.device.points["center"][None])[0]
    for _ in range(_TRIES):
        camera_from_device = camera_from_camera1 @ about_point(settings.device.draw(generator), centre) @ nominal
        if _inside(mesh, camera_from_device, carm, settings.device_margin_mm):
            moved = _draw_move(known.head, settings.moved_deg, settings.moved_mm, generator)
            place = known.device.points["center"]
            for view in range(1, len(camera_from_device)):
                drift = _draw_move(place, settings.device_moved_deg, settings.device_moved_mm, generator)
                if drift is not None:
                    camera_from_device[view] @= drift
            return Procedure(camera_from_pelvis, camera1_from_femur, camera_from_device, femur_motion[:3, :3], moved)
    raise InputError(
        f"simulation: the device never lies inside all images at {settings.device_depth_mm:g} mm from the source. "
        "Increase `device_depth_mm` or use a smaller device."
    )


def draw_stops(carm: CArm, settings: Acquisition, generator: torch.Generator) -> list[Tensor]:
    """`camera_from_room` (4, 4) of every C-arm stop; the room is the camera frame of the unperturbed first view."""
    isocentre = torch.tensor(carm.isocentre_mm, dtype=torch.float64)
    stops = []
    for mean, std in settings.orbit_deg:
        angle = torch.deg2rad(mean + std * torch.randn((), generator=generator, dtype=torch.float64))
        stops.append(about_point(settings.view.draw(generator), isocentre) @ carm.orbit(angle))
    return stops


def _draw_move(pivot: Tensor, deg: float, mm: float, generator: torch.Generator) -> Tensor | None:
    """A turn about a point (3,) and a shift (4, 4) of just these sizes, in random directions, if any."""
    if not (deg or mm):
        return None
    axis, direction = F.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
    return about_point(rigid(exp_so3(math.radians(deg) * axis), mm * direction), pivot)


def _inside(mesh: trimesh.Trimesh, camera_from_device: Tensor, carm: CArm, margin_mm: float) -> bool:
    """Whether the whole mesh falls on the detector, at least `margin_mm` from its edges, in all views."""
    vertices = torch.tensor(mesh.vertices, dtype=torch.float64)
    pixels = project_points(carm.camera, transform_points(camera_from_device, vertices))
    rows, columns = carm.camera.shape
    margin = margin_mm / torch.tensor(carm.camera.pixel_mm[::-1], dtype=torch.float64)
    last = torch.tensor([columns - 1, rows - 1], dtype=torch.float64)
    return bool(((pixels >= margin) & (pixels <= last - margin)).all())
