"""Poses of a patient under the C-arm as they occur in theatre, for labelled training images."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import about_point, exp_so3, rigid
from femoreg_torch.settings import check_rising, check_within

# which landmark is the head of a femur
FEMORAL_HEADS = {f"femur_{side}": HIP.landmark_names.index(f"FH-{side[0]}") for side in ("left", "right")}

# Antero-posterior beam: columns run to the patient's left, rows to the feet, the ray to the back.
_AP_FROM_LPS = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
# Postero-anterior beam, seen from behind; the picture is mirrored for display, so that patient left is on the right.
_PA_FROM_LPS = torch.tensor([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]], dtype=torch.float64)


@dataclass(frozen=True)
class ViewRanges:
    """Half-ranges of the draws; angles in degrees, lengths in mm."""

    orbital_deg: float = 60.0  # about the patient's long axis, triangular: views near AP are the common ones
    cranio_caudal_deg: float = 30.0  # triangular as well
    in_plane_deg: float = 15.0
    depth_mm: tuple[float, float] = (580.0, 880.0)  # source to the middle of the femoral heads
    shift_mm: float = 45.0  # across and along, in the plane of the femoral heads
    one_hip_share: float = 0.5  # views aimed at one hip instead of the middle of the pelvis
    cranial_share: float = 0.25  # views moved up the patient, so that the lumbar spine is in the image
    cranial_mm: tuple[float, float] = (30.0, 100.0)  # by so much, instead of the shift along
    posterior_share: float = 0.3  # views with the source behind the patient
    hip_rotation_deg: tuple[float, float, float] = (20.0, 12.0, 25.0)  # flexion, abduction, internal rotation
    steep_share: float = 0.0  # inlet and outlet views
    steep_deg: tuple[float, float] = (25.0, 50.0)  # their cranio-caudal angle, either way
    side_share: float = 0.0  # views from the patient's left or right, as the source sees them
    side_deg: tuple[float, float] = (20.0, 45.0)  # half-ranges about them: orbital, cranio-caudal
    frog_share: float = 0.0  # femora that are flexed, abducted and turned outwards, as in a frog-leg view
    frog_deg: tuple[float, float, float] = (90.0, 50.0, 50.0)  # by 0 to so much
    size: float = 0.10  # change of all lengths
    stretch: float = 0.06  # change of single axes, and shear

    def __post_init__(self) -> None:
        check_within(
            self,
            orbital_deg=(0, 180),
            cranio_caudal_deg=(0, 180),
            in_plane_deg=(0, 180),
            depth_mm=(100, 2500),
            shift_mm=(0, 500),
            one_hip_share=(0, 1),
            cranial_share=(0, 1),
            cranial_mm=(-500, 500),
            posterior_share=(0, 1),
            hip_rotation_deg=(0, 180),
            steep_share=(0, 1),
            steep_deg=(0, 90),
            side_share=(0, 1),
            side_deg=(0, 90),
            frog_share=(0, 1),
            frog_deg=(0, 180),
            size=(0, 0.5),
            stretch=(0, 0.5),
        )
        check_rising(self, "depth_mm", "cranial_mm", "steep_deg")
        if self.steep_share + self.side_share > 1:
            raise InputError("steep_share and side_share: a sum of at most 1 was expected.")


@dataclass(frozen=True)
class LabelledPose:
    """Where one view sees the patient. All transforms are affine (a patient is also stretched), 4×4 float64."""

    camera_from_lps: Tensor  # tissue and pelvis
    camera_from_femur: dict[str, Tensor]  # of each femur by name
    mirrored: bool  # the image is flipped left to right for display

    def camera_from(self, bone: str) -> Tensor:
        """The transform of the bone of this name."""
        return self.camera_from_femur.get(bone, self.camera_from_lps)


def _about_axes(angles_deg: np.ndarray) -> Tensor:
    """Rotation (3, 3) about the fixed axes x, then y, then z."""
    x, y, z = _about_each_axis(angles_deg)
    return z @ y @ x


def _about_each_axis(angles_deg: np.ndarray) -> Tensor:
    """Rotations (3, 3, 3) about x, y and z."""
    return exp_so3(torch.diag(torch.from_numpy(np.radians(angles_deg))))


def _stretch(ranges: ViewRanges, centre: Tensor, rng: np.random.Generator) -> Tensor:
    """Affine change of the patient's size and proportions about `centre` (3,), LPS to LPS."""
    linear = np.diag(1 + rng.uniform(-ranges.size, ranges.size) + rng.uniform(-ranges.stretch, ranges.stretch, 3))
    linear += np.triu(rng.uniform(-ranges.stretch, ranges.stretch, (3, 3)), 1)
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = torch.from_numpy(linear)
    affine[:3, 3] = centre - affine[:3, :3] @ centre
    return affine


def sample_pose(ranges: ViewRanges, landmarks: Tensor, rng: np.random.Generator) -> LabelledPose:
    """A random view of a patient whose `landmarks` (L, 3) are in LPS mm, in the order of the anatomy's."""
    heads = landmarks[list(FEMORAL_HEADS.values())]
    middle = heads.mean(0)
    stretch = _stretch(ranges, middle, rng)
    rotation, mirrored = _direction(ranges, rng)
    aim = middle
    if rng.random() < ranges.one_hip_share:
        head = heads[rng.integers(2)]
        aim = head + rng.uniform(0, 0.6) * (middle - head)
    target = np.append(rng.uniform(-ranges.shift_mm, ranges.shift_mm, 2), rng.uniform(*ranges.depth_mm))
    if rng.random() < ranges.cranial_share:
        target[1] = rng.uniform(*ranges.cranial_mm)  # image rows run to the feet
    camera_from_lps = rigid(rotation, torch.from_numpy(target) - rotation @ aim) @ stretch
    return LabelledPose(camera_from_lps, _turned_femora(ranges, landmarks, camera_from_lps, rng), mirrored)


def _direction(ranges: ViewRanges, rng: np.random.Generator) -> tuple[Tensor, bool]:
    """Rotation (3, 3) from LPS to the camera, and whether the image is mirrored for display."""
    kind = rng.random() if ranges.steep_share + ranges.side_share else 1.0  # else as before there were kinds
    if kind < ranges.side_share:
        orbital, cranio_caudal, in_plane = (
            rng.choice([-90.0, 90.0]) + rng.uniform(-ranges.side_deg[0], ranges.side_deg[0]),
            rng.uniform(-ranges.side_deg[1], ranges.side_deg[1]),
            rng.uniform(-ranges.in_plane_deg, ranges.in_plane_deg),
        )
        x, y, z = _about_each_axis(np.array([cranio_caudal, orbital, in_plane]))
        return z @ x @ y @ _AP_FROM_LPS, False  # the patient's long axis first: the other way it would turn the image
    angles = np.array(
        [
            rng.triangular(-ranges.cranio_caudal_deg, 0, ranges.cranio_caudal_deg),
            rng.triangular(-ranges.orbital_deg, 0, ranges.orbital_deg),
            rng.uniform(-ranges.in_plane_deg, ranges.in_plane_deg),
        ]
    )
    if kind < ranges.side_share + ranges.steep_share:
        angles[0] = rng.choice([-1.0, 1.0]) * rng.uniform(*ranges.steep_deg)
    mirrored = bool(rng.random() < ranges.posterior_share)
    return _about_axes(angles) @ (_PA_FROM_LPS if mirrored else _AP_FROM_LPS), mirrored


def _turned_femora(
    ranges: ViewRanges, landmarks: Tensor, camera_from_lps: Tensor, rng: np.random.Generator
) -> dict[str, Tensor]:
    """Each femur turned about its head by angles of its own."""
    poses = {}
    for femur, head in FEMORAL_HEADS.items():
        x, y, z = rng.uniform(-1, 1, 3) * ranges.hip_rotation_deg
        turn = _about_axes(np.array([x, y, z]))
        if ranges.frog_share and rng.random() < ranges.frog_share:
            turn = _frog_leg(ranges, femur, rng)
        poses[femur] = camera_from_lps @ about_point(rigid(turn), landmarks[head])
    return poses


def _frog_leg(ranges: ViewRanges, femur: str, rng: np.random.Generator) -> Tensor:
    """Rotation (3, 3) of a femur in LPS: outwards about its long axis, then flexed, then abducted."""
    flexed, abducted, outwards = rng.uniform(0, 1, 3) * ranges.frog_deg
    left = 1.0 if femur == "femur_left" else -1.0  # +x is the patient's left, −y the front
    x, y, z = _about_each_axis(np.array([-flexed, -left * abducted, left * outwards]))
    return y @ x @ z
