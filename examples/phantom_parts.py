"""What the examples share: a small object without any symmetry, and images of it."""

import torch
from torch import Tensor

import femoreg_torch as femoreg

MIDDLE = torch.zeros(3, dtype=torch.float64)  # of the object, in its own space


def lumpy_object(seed: int = 1, spacing_mm: float = 2.0) -> femoreg.Volume:
    """Twelve dense balls scattered through a box of 80 × 60 × 100 mm; attenuation in 1/mm."""
    generator = torch.Generator().manual_seed(seed)
    centres = (torch.rand(12, 3, generator=generator) - 0.5) * torch.tensor([60.0, 40.0, 80.0])
    radii = 5 + 7 * torch.rand(12, generator=generator)
    axes = [torch.arange(-half, half + spacing_mm / 2, spacing_mm) for half in (50.0, 30.0, 40.0)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    points = torch.stack([x, y, z], -1)
    depth = radii - (points[..., None, :] - centres).norm(dim=-1)  # of every voxel in every ball
    data = 0.05 * (depth.amax(-1) / spacing_mm + 0.5).clamp(0, 1)
    lps_from_index = torch.diag(torch.tensor([spacing_mm] * 3 + [1.0], dtype=torch.float64))
    lps_from_index[:3, 3] = torch.tensor([-40.0, -30.0, -50.0], dtype=torch.float64)
    return femoreg.Volume(data.float(), lps_from_index)


def noisy(image: Tensor, seed: int = 0, photons: float = 200_000.0) -> Tensor:
    """An attenuation image (H, W) as so many photons per pixel show it."""
    generator = torch.Generator().manual_seed(seed)
    counts = torch.poisson(photons * (-image).exp(), generator=generator).clamp_min(1)
    return -(counts / photons).log()


def two_views(binning: int, offset_mm: tuple[float, float, float]) -> tuple[femoreg.Scene, Tensor]:
    """One object in two views from known C-arm poses, and its true pose (4, 4); it starts so far off (camera 1)."""
    carm, volume = femoreg.load_carm("cios_fusion"), lumpy_object()
    cameras = carm.orbit(torch.deg2rad(torch.tensor([0.0, 40.0], dtype=torch.float64)))  # of both views, from view 1
    truth = torch.eye(4, dtype=torch.float64)
    truth[:3, 3] = torch.tensor([5.0, -8.0, 640.0])
    camera = carm.camera.downsampled(binning)
    images = femoreg.project(volume, cameras @ truth, camera, step_mm=0.5)
    start = truth.clone()
    start[:3, 3] += torch.tensor(offset_mm)
    thing = femoreg.RigidObject(volume, MIDDLE, ("image",), femoreg.Start(camera1_from=start))
    scene = femoreg.Scene(
        femoreg.CArm(camera, carm.isocentre_mm, carm.orbit_axis),
        {"object": thing},
        {"image": tuple(noisy(image, seed) for seed, image in enumerate(images))},
        camera_from_camera1=cameras,
    )
    return scene, truth
