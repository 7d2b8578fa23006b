"""This project's projector and its peers behind one call: poses (B, 4, 4) → line integrals (B, H, W).

All take the same volume, camera and `camera_from_volume`, and are differentiable in the poses.
"""

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera
from femoreg_torch.volume.grid import Volume

Render = Callable[[Tensor], Tensor]
Build = Callable[[Volume, Camera, str], tuple[str, Render]]


def unit_rays(camera: Camera) -> Tensor:
    ray = camera.pixel_positions()
    return ray / ray.norm(dim=-1, keepdim=True)


def chords(volume: Volume, camera: Camera, camera_from_volume: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) in mm at which the rays that meet the volume's box enter and leave it, for one pose."""
    index_from_camera = torch.linalg.inv(camera_from_volume @ volume.lps_from_index)
    direction, source = unit_rays(camera) @ index_from_camera[:3, :3].T, index_from_camera[:3, 3]
    last = torch.tensor(volume.data.shape[::-1], dtype=torch.float64) - 0.5
    faces = torch.stack([-0.5 - source, last - source], -2) / direction[..., None, :]
    enter, leave = faces.amin(-2).amax(-1), faces.amax(-2).amin(-1)
    return enter[leave > enter], leave[leave > enter]


def femoreg(volume: Volume, camera: Camera, device: str, step_mm: float) -> tuple[str, Render]:
    """This project."""
    posed = Volume(volume.data.to(device), volume.lps_from_index)
    return "FemoReg Torch", lambda poses: project([posed], poses[:, None], camera, step_mm)


def nanodrr(volume: Volume, camera: Camera, device: str, step_mm: float | None) -> tuple[str, Render]:
    """nanodrr, default back end; samples so that they lie `step_mm` apart in the volume on average, or its default."""
    from nanodrr.data import Subject
    from nanodrr.drr import render

    values = volume.data[None, None].to(device)
    affine = volume.lps_from_index
    subject = Subject(
        values,
        torch.zeros_like(values),
        affine.float(),
        torch.linalg.inv(affine).float(),
        Subject._make_voxel_to_grid(values.shape),
        volume.centre().float(),
        convert_to_mu=False,
    ).to(device)
    matrix = camera.matrix()
    matrix[:2, 2] += 0.5  # its pixel centres lie at + 0.5
    inverse = torch.linalg.inv(matrix).float().to(device)

    @cache  # once for each pose, so that it does not count
    def samples(pose: tuple[float, ...]) -> int:
        enter, leave = chords(volume, camera, torch.tensor(pose, dtype=torch.float64).view(4, 4))
        return max(2, round((leave - enter).mean().item() / step_mm)) if step_mm else 500

    def image(poses: Tensor) -> Tensor:
        count = len(poses)
        volume_from_camera = torch.linalg.inv(poses.double()).float().to(device)
        sdd = torch.full((count,), camera.sdd_mm, device=device)
        intrinsics = inverse.expand(count, -1, -1)
        n = samples(tuple(poses[0].detach().flatten().tolist()))
        return render(subject, intrinsics, volume_from_camera, sdd, *camera.shape, n_samples=n)[:, 0]

    return f"nanodrr, {f'{step_mm:g} mm steps' if step_mm else 'its default of 500 samples'}", image


def diffdrr(volume: Volume, camera: Camera, device: str, step_mm: float | None) -> tuple[str, Render]:
    """DiffDRR's renderers, given rays in voxel coordinates: trilinear at `step_mm`, or Siddon if that is None."""
    from diffdrr.renderers import Siddon, Trilinear

    data = volume.data.permute(2, 1, 0).contiguous().to(device)  # it indexes [x, y, z]
    index_from_volume = torch.linalg.inv(volume.lps_from_index)
    pixels = camera.pixel_positions().reshape(1, -1, 3)
    lengths = pixels.norm(dim=-1).float()[:, None].to(device)
    renderer = Trilinear() if step_mm else Siddon()

    def image(poses: Tensor) -> Tensor:
        index_from_camera = index_from_volume @ torch.linalg.inv(poses.double())
        source = index_from_camera[:, None, :3, 3].float().to(device)
        target = (pixels @ index_from_camera[:, :3, :3].mT + index_from_camera[:, None, :3, 3]).float().to(device)
        settings = {}
        if step_mm:
            enter, leave = chords(volume, camera, poses[0].detach().cpu().double())
            settings["n_points"] = math.ceil((leave.max() - enter.min()).item() / step_mm)
        flat = renderer(data, source, target, lengths.expand(len(poses), -1, -1), **settings)
        return flat.reshape(len(poses), *camera.shape)

    return f"DiffDRR, {f'trilinear, {step_mm:g} mm steps' if step_mm else 'siddon'}", image


def compiled(volume: Volume, camera: Camera, device: str, step_mm: float) -> tuple[str, Render]:
    """The alternative to this project's kernels: eight gathers per sample in plain torch, fused by `torch.compile`.

    All rays take as many samples as the longest one needs; it needs a C++ compiler where it runs.
    """
    depth, height, width = (n + 2 for n in volume.data.shape)
    flat = torch.nn.functional.pad(volume.data, (1, 1, 1, 1, 1, 1)).flatten().to(device)
    rays = unit_rays(camera).reshape(-1, 3).float().to(device)
    index_from_volume = torch.linalg.inv(volume.lps_from_index)
    last = torch.tensor([width - 2, height - 2, depth - 2], device=device)

    @torch.compile(dynamic=False)
    def march(affine: Tensor, distances: Tensor) -> Tensor:
        x, y, z = ((rays @ affine[i, :3])[:, None] * distances + affine[i, 3] + 1 for i in range(3))
        inside = (x >= 0) & (y >= 0) & (z >= 0) & (x < last[0] + 1) & (y < last[1] + 1) & (z < last[2] + 1)
        i, j, k = (v.detach().floor().clamp(min=0).minimum(n).long() for v, n in zip((x, y, z), last, strict=True))
        u, v, w = x - i, y - j, z - k
        first = (k * height + j) * width + i
        total = torch.zeros_like(x)
        for corner in range(8):
            p, q, r = corner & 1, corner >> 1 & 1, corner >> 2
            share = (u if p else 1 - u) * (v if q else 1 - v) * (w if r else 1 - w)
            total = total + flat[first + (r * height + q) * width + p] * share
        return torch.where(inside, total, 0.0).sum(1) * step_mm

    def image(poses: Tensor) -> Tensor:
        affines = index_from_volume @ torch.linalg.inv(poses.double())
        images = []
        for affine, pose in zip(affines, poses.detach().double(), strict=True):
            enter, leave = chords(volume, camera, pose.cpu())
            first, end = math.floor(enter.min().item() / step_mm), math.ceil(leave.max().item() / step_mm)
            distances = torch.arange(first, end + 1, device=device) * step_mm
            images.append(march(affine.float().to(device), distances).reshape(camera.shape))
        return torch.stack(images)

    return f"eight gathers under torch.compile, {step_mm:g} mm steps", image


RENDERERS: dict[str, tuple[str | None, Build]] = {  # the package that must be there, and how to set the renderer up
    "femoreg": (None, partial(femoreg, step_mm=1.0)),
    "compiled": (None, partial(compiled, step_mm=1.0)),
    "nanodrr": ("nanodrr", partial(nanodrr, step_mm=1.0)),
    "nanodrr-default": ("nanodrr", partial(nanodrr, step_mm=None)),
    "diffdrr-trilinear": ("diffdrr", partial(diffdrr, step_mm=1.0)),
    "diffdrr-siddon": ("diffdrr", partial(diffdrr, step_mm=None)),
}
