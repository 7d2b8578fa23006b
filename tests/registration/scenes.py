"""A small operating room: three rigid objects, three views, images made by another projector than the one that registers."""

import math

import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.drr.reference import march
from femoreg_torch.geometry import CArm, about_point, centred_camera, exp_se3, invert_rigid, rigid, rotation_angle
from femoreg_torch.registration import Poses, Scene
from femoreg_torch.registration.scene import Kind
from femoreg_torch.volume import Volume, axis_aligned

CARM = CArm(centred_camera(1020.0, (4.0, 4.0), (64, 64)), (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
VOXEL_MM = 3.0
VIEW_ANGLES_DEG = (0.0, 10.0, -15.0)


def float64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def bone(seed: int, voxels: tuple[int, int, int], mu: float) -> Volume:
    """A lumpy object without any symmetry, in the middle of its own space."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.from_numpy(ndimage.gaussian_filter(torch.rand(*voxels, generator=generator).numpy(), 2.0))
    edge = torch.zeros(voxels)
    edge[3:-3, 3:-3, 3:-3] = 1
    filled = (noise > noise.quantile(0.6)) * edge
    soft = torch.from_numpy(ndimage.gaussian_filter(filled.float().numpy(), 0.7)) * mu
    origin = [-(n - 1) / 2 * VOXEL_MM for n in voxels[::-1]]
    return Volume(soft, axis_aligned((VOXEL_MM,) * 3, (origin[0], origin[1], origin[2])))


VOLUMES = {"pelvis": bone(1, (36, 28, 44), 0.02), "femur": bone(2, (30, 16, 14), 0.02), "device": bone(3, (10, 10, 26), 0.1)}
REFERENCE_POINTS = {"pelvis": float64(0, 0, 0), "femur": float64(0, 0, 30), "device": float64(0, 0, 0)}


def true_poses() -> Poses:
    """Pelvis and femur 740 mm from the source, the device in front of them; views along the orbit and a little off it."""
    off_orbit = [rigid(), exp_se3(float64(0.01, -0.012, 0.01, 2, -1.5, 3)), exp_se3(float64(-0.01, 0.01, -0.015, -1, 2, -3))]
    orbit = CARM.orbit(float64(*VIEW_ANGLES_DEG) * math.pi / 180)
    return Poses(
        torch.stack([extra @ turn for extra, turn in zip(off_orbit, orbit, strict=True)]),
        {
            "pelvis": exp_se3(float64(0.1, -0.2, 0.05, 0, 0, 0)) + _shift(-12, -8, 740),
            "femur": exp_se3(float64(-0.1, 0.15, 0.2, 0, 0, 0)) + _shift(58, 20, 745),
            "device": exp_se3(float64(0.2, 0.9, 0.3, 0, 0, 0)) + _shift(10, 12, 560),
        },
    )


def _shift(x: float, y: float, z: float) -> Tensor:
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[:3, 3] = float64(x, y, z)
    return matrix


def line_integrals(poses: Poses, view: int, names: tuple[str, ...]) -> Tensor:
    """Line integrals (H, W) by the float64 reference, on a grid twice as fine and averaged, with a step of 0.7 mm."""
    fine = centred_camera(1020.0, (2.0, 2.0), (128, 128))
    total = torch.zeros(fine.shape, dtype=torch.float64)
    for name in names:
        index_from_camera = invert_rigid(poses.camera_from(name)[view])
        scale = torch.linalg.inv(VOLUMES[name].lps_from_index)
        total += march(VOLUMES[name].data.double(), (scale @ index_from_camera)[None], fine, 0.7)[0]
    return torch.nn.functional.avg_pool2d(total[None, None], 2)[0, 0]


def make_scene(poses: Poses, seed: int = 0, with_device: bool = True) -> Scene:
    """Noisy images of all views with all objects at `poses`."""
    generator = torch.Generator().manual_seed(seed)

    def image(view: int, names: tuple[str, ...]) -> Tensor:
        exact = line_integrals(poses, view, names)
        return (exact + 0.01 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)).float()

    views = range(len(poses.camera_from_camera1))
    images: dict[Kind, tuple[Tensor, ...]] = {"anatomy": tuple(image(v, ("pelvis", "femur")) for v in views)}
    if with_device:
        images["device"] = tuple(image(v, ("pelvis", "femur", "device")) for v in views)
    return Scene(CARM, VOLUMES, REFERENCE_POINTS, images)


def off(pose: Tensor, point: Tensor, rotation_deg: tuple[float, ...], translation_mm: tuple[float, ...]) -> Tensor:
    """A pose (4, 4) turned about one of the object's own points (3,) and shifted, in camera axes."""
    twist = torch.cat([float64(*rotation_deg) * math.pi / 180, float64(*translation_mm)])
    return about_point(exp_se3(twist), (pose @ torch.cat([point, float64(1)]))[:3]) @ pose


def error(estimate: Tensor, truth: Tensor, point: Tensor) -> tuple[float, float]:
    """Displacement in mm of one of the object's points, and the angle in degrees, between two poses (4, 4)."""
    homogeneous = torch.cat([point, float64(1)])
    angle = rotation_angle(estimate[:3, :3] @ truth[:3, :3].T)
    return float(((estimate - truth) @ homogeneous).norm()), math.degrees(float(angle))
