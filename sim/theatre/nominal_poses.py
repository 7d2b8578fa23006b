"""Where patient and device are meant to be under the C-arm, before anything moves at random.

Camera frame as everywhere: x along columns, y along rows, z away from the source. In the nominal AP view the source
stands in front of the patient, so x is the patient's left, y is down and z is towards the back.
"""

import torch
import trimesh
from torch import Tensor

from femoreg_torch.case.model import Side
from femoreg_torch.geometry import rigid
from sim.theatre.settings import Acquisition

_AP_ROTATION = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # camera from LPS


def nominal_ap(head_centre: Tensor, side: Side, settings: Acquisition) -> Tensor:
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
