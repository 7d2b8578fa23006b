"""The paper's acquisition (section III-A) as poses: a nominal AP view, everything that moves at random, and the truth.

Camera frame as everywhere: x along columns, y along rows, z away from the source. In the nominal AP view the source
stands in front of the patient, so x is the patient's left, y is down and z is towards the back.
"""

import math
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.case import Case, Truth
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CArm, about_point, exp_so3, invert_rigid, project_points, rigid, transform_points
from sim.settings import read_settings, record, section
from sim.xray import XrayModel

_AP_ROTATION = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # camera from LPS
_TRIES = 200


@dataclass(frozen=True)
class Motion:
    """A random rigid motion: angle uniform in ± `angle_deg` about a random axis, shift uniform in 0 to `shift_mm`."""

    angle_deg: float
    shift_mm: float

    def draw(self, generator: torch.Generator) -> Tensor:
        """One motion (4, 4); axis and direction are uniform on the sphere."""
        angle, length = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        axis, direction = F.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
        return rigid(exp_so3(math.radians(self.angle_deg) * (2 * angle - 1) * axis), self.shift_mm * length * direction)


@dataclass(frozen=True)
class Acquisition:
    """Settings of the simulated acquisition; their meaning is told in `configs/simulation/paper.yaml`."""

    head_depth_mm: float
    head_lateral_mm: float
    head_caudal_mm: float
    orbit_deg: tuple[tuple[float, float], ...]  # mean and standard deviation per view
    view: Motion
    pelvis: Motion
    femur: Motion
    device: Motion
    device_hu: float
    device_depth_mm: float
    device_margin_mm: float
    step_mm: float


@dataclass(frozen=True)
class Procedure:
    """One drawn procedure: the truth, where the device is in every view, and how the femur has turned."""

    truth: Truth
    camera_from_device: Tensor  # (V, 4, 4)
    femur_rotation: Tensor  # (3, 3), in LPS about the femoral head centre


def load_settings(config: str) -> tuple[Acquisition, XrayModel]:
    """Settings from a preset (`configs/simulation/`) or from a YAML file. Raises `InputError` that names the key."""
    settings = read_settings(config)
    where = f"simulation settings {config}"
    acquisition = dict(section(settings, "acquisition", where))
    for name in ("view", "pelvis", "femur", "device"):
        acquisition[name] = record(Motion, section(acquisition, name, f"{where}, acquisition"), f"{where}, {name}")
    acquisition["orbit_deg"] = tuple((float(mean), float(std)) for mean, std in acquisition.get("orbit_deg", ()))
    return (
        record(Acquisition, acquisition, f"{where}, acquisition"),
        record(XrayModel, section(settings, "xray", where), f"{where}, xray"),
    )


def nominal_ap(head_centre: Tensor, side: str, settings: Acquisition) -> Tensor:
    """`camera_from_lps` (4, 4) of the nominal AP view of a hip whose head centre (3,) is in LPS mm."""
    lateral = settings.head_lateral_mm * (1 if side == "left" else -1)
    head_camera = torch.tensor([lateral, settings.head_caudal_mm, settings.head_depth_mm], dtype=torch.float64)
    return rigid(_AP_ROTATION, head_camera - _AP_ROTATION @ head_centre)


def nominal_device(mesh: trimesh.Trimesh, points: dict[str, Tensor], path_camera: Tensor, depth_mm: float) -> Tensor:
    """`camera1_from_device` (4, 4): the middle of the device on the central ray, its guide parallel to the detector.

    The guide (base → tip) points along the image of the planned path, `path_camera` (3,); what the device carries to
    one side of its guide points away from the patient's head, down the image.
    """
    guide = _unit(points["tip"] - points["base"])
    middle = torch.tensor(mesh.bounds.mean(0), dtype=torch.float64)
    lean = middle - points["base"]
    lean = lean - (lean @ guide) * guide
    if lean.norm() < 1:  # a device of revolution has no side
        lean = torch.linalg.cross(guide, guide.roll(1))
    forward = _unit(torch.tensor([path_camera[0], path_camera[1], 0.0], dtype=torch.float64))
    sideways = torch.tensor([-forward[1], forward[0], 0.0], dtype=torch.float64)
    sideways = sideways if sideways[1] >= 0 else -sideways
    rotation = _frame(forward, sideways) @ _frame(guide, _unit(lean)).T
    return rigid(rotation, torch.tensor([0.0, 0.0, depth_mm], dtype=torch.float64) - rotation @ middle)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm()


def _frame(first: Tensor, second: Tensor) -> Tensor:
    """Right-handed axes (3, 3), as columns, of two orthogonal unit vectors."""
    return torch.stack([first, second, torch.linalg.cross(first, second)], 1)


def draw_procedure(
    skeleton: Case, mesh: trimesh.Trimesh, settings: Acquisition, generator: torch.Generator
) -> Procedure:
    """Draw every pose of one procedure.

    The pelvis moves about the point where the central ray passes the depth of the femoral head, each C-arm stop about
    the isocentre, the femur about the centre of its head, the device about its `center` near its nominal pose. The
    device is drawn again until it lies inside all images. Raises `InputError` if it never does.
    """
    carm, head = skeleton.carm, skeleton.femoral_head
    ap = nominal_ap(head, skeleton.side, settings)
    pivot = torch.tensor([0.0, 0.0, settings.head_depth_mm], dtype=torch.float64)
    room_from_pelvis = about_point(settings.pelvis.draw(generator), pivot) @ ap
    camera_from_pelvis = torch.stack([stop @ room_from_pelvis for stop in _draw_stops(carm, settings, generator)])

    femur_motion = settings.femur.draw(generator)
    camera1_from_femur = camera_from_pelvis[0] @ about_point(femur_motion, head)

    device = skeleton.device
    assert device is not None  # a skeleton always has one
    nominal = device.camera1_from_device
    camera_from_camera1 = camera_from_pelvis @ invert_rigid(camera_from_pelvis[0])
    centre = transform_points(nominal, device.points["center"][None])[0]
    for _ in range(_TRIES):
        camera_from_device = camera_from_camera1 @ about_point(settings.device.draw(generator), centre) @ nominal
        if _inside(mesh, camera_from_device, carm, settings.device_margin_mm):
            truth = Truth(camera_from_pelvis, camera1_from_femur, camera_from_device[0])
            return Procedure(truth, camera_from_device, femur_motion[:3, :3])
    raise InputError(
        f"simulation: the device never lies inside all images at {settings.device_depth_mm:g} mm from the source. "
        "Increase `device_depth_mm` or use a smaller device."
    )


def _draw_stops(carm: CArm, settings: Acquisition, generator: torch.Generator) -> list[Tensor]:
    """`camera_from_room` (4, 4) of every C-arm stop; the room is the camera frame of the unperturbed first view."""
    isocentre = torch.tensor(carm.isocentre_mm, dtype=torch.float64)
    stops = []
    for mean, std in settings.orbit_deg:
        angle = torch.deg2rad(mean + std * torch.randn((), generator=generator, dtype=torch.float64))
        stops.append(about_point(settings.view.draw(generator), isocentre) @ carm.orbit(angle))
    return stops


def _inside(mesh: trimesh.Trimesh, camera_from_device: Tensor, carm: CArm, margin_mm: float) -> bool:
    """Whether the whole mesh falls on the detector, at least `margin_mm` from its edges, in all views."""
    vertices = torch.tensor(mesh.vertices, dtype=torch.float64)
    pixels = project_points(carm.camera, transform_points(camera_from_device, vertices))
    rows, columns = carm.camera.shape
    margin = margin_mm / torch.tensor(carm.camera.pixel_mm[::-1], dtype=torch.float64)
    last = torch.tensor([columns - 1, rows - 1], dtype=torch.float64)
    return bool(((pixels >= margin) & (pixels <= last - margin)).all())
