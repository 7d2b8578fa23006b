"""Phantoms and poses of the projector's tests, and the float64 truth to compare with."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.drr.reference import march
from femoreg_torch.geometry import Camera, centred_camera, exp_so3, rigid
from femoreg_torch.volume.grid import Volume, axis_aligned

CAMERA = centred_camera(1020.0, (4.0, 4.0), (48, 40))
DEVIATING_CAMERA = Camera(900.0, (3.0, 5.0), (37, 29), (20.3, 11.8))  # off centre, pixels not square


def float64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def facing(
    z_mm: float = 620.0, rotation_vector: Sequence[float] = (0, 0, 0), x_mm: float = 0, y_mm: float = 0
) -> Tensor:
    """A pose (1, 1, 4, 4) that turns a volume about its own origin and puts that at (x, y, z) in the camera frame."""
    return rigid(exp_so3(float64(*rotation_vector)), float64(x_mm, y_mm, z_mm))[None, None]


def random_poses(count: int, volumes: int, generator: torch.Generator, z_mm: float = 620.0) -> Tensor:
    """Poses (count, volumes, 4, 4): any rotation, up to 40 mm to the side and 100 mm in depth."""
    vectors = torch.randn(count, volumes, 3, generator=generator, dtype=torch.float64)
    shifts = 2 * torch.rand(count, volumes, 3, generator=generator, dtype=torch.float64) - 1
    return rigid(exp_so3(vectors), shifts * float64(40, 40, 100) + float64(0, 0, z_mm))


def centred(
    data: Tensor, spacing_mm: Sequence[float] = (1, 1, 1), rotation_vector: Sequence[float] = (0, 0, 0)
) -> Volume:
    """A volume whose grid has its middle at the origin and its axes turned by `rotation_vector`."""
    x, y, z = (float(s) for s in spacing_mm)
    grid = axis_aligned((x, y, z), (0.0, 0.0, 0.0))
    middle = (float64(*data.shape[::-1]) - 1) / 2
    grid[:3, 3] = -grid[:3, :3] @ middle
    return Volume(data, rigid(exp_so3(float64(*rotation_vector))) @ grid)


def smooth(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Positive values that change over a few voxels; nowhere empty."""
    noise = torch.rand(*shape, generator=generator)
    return torch.from_numpy(ndimage.uniform_filter(noise.numpy(), 3, mode="nearest")) * 0.05


def sparse(shape: Sequence[int], generator: torch.Generator, share: float = 0.01) -> Tensor:
    """Single voxels of random value in empty space: what the skipping is most likely to miss."""
    filled = torch.rand(*shape, generator=generator) < share
    return filled * (0.2 + torch.rand(*shape, generator=generator))


def voxel_positions(volume: Volume) -> Tensor:
    """Voxel centres (Z, Y, X, 3) in mm."""
    axes = [torch.arange(n, dtype=torch.float64) for n in volume.data.shape]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    grid = torch.stack([x, y, z], -1)
    return grid @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]


def gaussian_ball(grid: Volume, centre: Tensor, sigma_mm: float) -> Volume:
    """A ball without an edge, exp(−r² / 2σ²): its line integrals are σ √(2π) exp(−d² / 2σ²) at distance d."""
    squared = ((voxel_positions(grid) - centre) ** 2).sum(-1)
    return grid.with_data(torch.exp(-squared / (2 * sigma_mm**2)).float())


def unit_rays(camera: Camera) -> Tensor:
    ray = camera.pixel_positions()
    return ray / ray.norm(dim=-1, keepdim=True)


def distances(camera: Camera, point_camera: Tensor) -> Tensor:
    """Distance (H, W) in mm of a point from every ray."""
    ray = unit_rays(camera)
    return torch.linalg.cross(ray, point_camera.expand_as(ray)).norm(dim=-1)


def ball_integral(distance: Tensor, sigma_mm: float) -> Tensor:
    return sigma_mm * math.sqrt(2 * math.pi) * torch.exp(-(distance**2) / (2 * sigma_mm**2))


def box_chord(camera: Camera, camera_from_box: Tensor, half_mm: Tensor) -> tuple[Tensor, Tensor]:
    """Length (H, W) in mm of each ray inside a box of 1 mm voxels about the origin, from the source on, and a mask.

    At its faces a sampled box fades over one voxel, which leaves chords as they are, except where two faces fade at
    once: the mask is where the ray keeps away from all edges.
    """
    box_from_camera = torch.linalg.inv(camera_from_box)
    direction, source = unit_rays(camera) @ box_from_camera[:3, :3].T, box_from_camera[:3, 3]

    def interval(half: Tensor) -> tuple[Tensor, Tensor]:
        faces = torch.stack([-half - source, half - source], -2) / direction[..., None, :]
        enter = faces.amin(-2).amax(-1).clamp(min=0)
        return enter, torch.maximum(enter, faces.amax(-2).amin(-1))

    enter, leave = interval(half_mm)
    first, last = interval(half_mm + 1)
    t = first[..., None] + (last - first)[..., None] * torch.linspace(0, 1, 500, dtype=torch.float64)
    depth = half_mm - (source + t[..., None] * direction[..., None, :]).abs()  # below each pair of faces
    at_edge = ((depth.abs() < 0.6).sum(-1) >= 2) & (depth > -0.6).all(-1)
    return leave - enter, ~at_edge.any(-1)


def truth(volumes: Sequence[Volume], poses: Tensor, camera: Camera, step_mm: float = 1.0) -> Tensor:
    """Line integrals (B, V, H, W) in float64, sampled by SciPy every `step_mm`.

    Samples are counted from a quarter of a voxel off the volume's middle.
    """
    ray = unit_rays(camera).numpy()
    images = np.zeros((*poses.shape[:2], *camera.shape))
    for v, volume in enumerate(volumes):
        data = volume.data.detach().double().numpy()
        corners = (np.stack(np.meshgrid(*[(-1.0, n) for n in data.shape[::-1]]), -1)).reshape(-1, 3)
        for b, pose in enumerate(poses[:, v]):
            camera_from_index = (pose @ volume.lps_from_index).numpy()
            distance = np.linalg.norm(camera_from_index[:3] @ [*((n - 1) // 2 + 0.25 for n in data.shape[::-1]), 1])
            offset = distance % step_mm
            depths = corners @ camera_from_index[2, :3] + camera_from_index[2, 3]
            distances = np.linalg.norm(corners @ camera_from_index[:3, :3].T + camera_from_index[:3, 3], axis=1)
            first = max(0, math.floor((depths.min() - offset) / step_mm))
            along = offset + step_mm * np.arange(first, math.ceil((distances.max() - offset) / step_mm) + 1)
            index_from_camera = np.linalg.inv(camera_from_index)
            x, y, z = np.moveaxis(index_from_camera[:3, :3] @ ray[..., None], -2, 0) * along
            points = np.stack([z, y, x]) + index_from_camera[2::-1, 3, None, None, None]
            images[b, v] = step_mm * ndimage.map_coordinates(data, points, order=1, mode="grid-constant").sum(-1)
    return torch.from_numpy(images)


def offsets(volume: Volume, poses: Tensor, step_mm: float) -> Tensor:
    """Of samples that are counted from a quarter of a voxel off the volume's middle, (B,) mm, for poses (B, 4, 4)."""
    middle = torch.tensor([*((n - 1) // 2 + 0.25 for n in volume.data.shape[::-1]), 1.0], dtype=torch.float64)
    return (poses @ volume.lps_from_index @ middle)[:, :3].norm(dim=1).remainder(step_mm)


def marched(volumes: Sequence[Volume], poses: Tensor, camera: Camera, step_mm: float = 1.0) -> Tensor:
    """The same by the plain march in float64, which autograd goes through."""
    images = []
    for v, volume in enumerate(volumes):
        index_from_camera = torch.linalg.inv(poses[:, v] @ volume.lps_from_index)
        images.append(march(volume.data, index_from_camera, camera, offsets(volume, poses[:, v], step_mm), step_mm))
    return torch.stack(images, 1)


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference, relative to the largest expected value."""
    return ((found.double() - expected).abs().max() / expected.abs().max().clamp(min=1e-30)).item()
