"""Where a device is meant to stand beside the bone, in words, so that nobody has to type a matrix."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.case.model import PlannedPath, Side
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3, rigid

ALONG_PATH = "along the planned path"
# Directions in LPS that a guide may point along; lateral and medial change with the side.
_FROM = {
    "the front": (0.0, 1.0, 0.0),
    "the back": (0.0, -1.0, 0.0),
    "above": (0.0, 0.0, -1.0),
    "below": (0.0, 0.0, 1.0),
}
_LATERAL = {"the side": 1.0, "the middle": -1.0}  # times +R for the left side
GUIDES = (ALONG_PATH, *(f"from {word}" for word in (*_LATERAL, *_FROM)))
_FRONT, _HEAD = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
_OFF_AXIS_MM = 1.0  # a device whose middle is nearer to its guide than that is one of revolution


@dataclass(frozen=True)
class NominalPlace:
    """A sentence: the guide points this way, its tip this far before (or, negative, past) the entry point."""

    guide: str = ALONG_PATH  # one of `GUIDES`
    before_entry_mm: float = 0.0
    turned_deg: float = 0.0
    in_front_mm: float = 0.0  # all of it moved towards the patient's front by that

    def __post_init__(self) -> None:
        if self.guide not in GUIDES:
            raise InputError(f"guide: one of {', '.join(GUIDES)} was expected, found {self.guide!r}.")


def bone_from_device(place: NominalPlace, path: PlannedPath, side: Side, points: dict[str, Tensor]) -> Tensor:
    """`bone_from_device` (4, 4): where a device with the points `tip`, `base` and `center` stands in LPS mm of the CT.

    Not turned, what the device carries to one side of its guide (towards `center`; without such a side, the axis of its
    space that is nearest to a right angle with the guide) points to the front of the patient, and for a guide from the
    front or the back towards the head. Turned, it goes round by the right-hand rule about base → tip.
    """
    forward = _direction(place.guide, path, side)
    guide = _unit(points["tip"] - points["base"])
    up = torch.tensor(_HEAD if abs(float(forward[1])) > math.cos(math.radians(20)) else _FRONT, dtype=torch.float64)
    upright = _frame(forward, _across(up, forward))
    rotation = exp_so3(math.radians(place.turned_deg) * forward) @ upright @ _frame(guide, _side_of(points, guide)).T
    front = torch.tensor(_FRONT, dtype=torch.float64)
    tip = path.entry_point - place.before_entry_mm * forward + place.in_front_mm * front
    return rigid(rotation, tip - rotation @ points["tip"])


def _direction(guide: str, path: PlannedPath, side: Side) -> Tensor:
    if guide == ALONG_PATH:
        return _unit(path.target - path.entry_point)
    word = guide.removeprefix("from ")
    if word in _LATERAL:
        return torch.tensor([-_LATERAL[word] if side == "left" else _LATERAL[word], 0.0, 0.0], dtype=torch.float64)
    return torch.tensor(_FROM[word], dtype=torch.float64)


def _side_of(points: dict[str, Tensor], guide: Tensor) -> Tensor:
    """Unit vector (3,) across the guide towards what the device carries to one side."""
    lean = points["center"] - points["base"]
    lean = lean - (lean @ guide) * guide
    if lean.norm() < _OFF_AXIS_MM:
        axis = torch.eye(3, dtype=torch.float64)[int(guide.abs().argmin())]
        return _across(axis, guide)
    return _unit(lean)


def _across(vector: Tensor, axis: Tensor) -> Tensor:
    return _unit(vector - (vector @ axis) * axis)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm()


def _frame(first: Tensor, second: Tensor) -> Tensor:
    """Right-handed axes (3, 3), as columns, of two unit vectors at right angles."""
    return torch.stack([first, second, torch.linalg.cross(first, second)], 1)
