"""The projector as plain ray marching in torch, on any device, in any float dtype: the reference of the tests."""

import torch
from torch import Tensor

from femoreg_torch.geometry.camera import Camera


def trilinear(data: Tensor, points: Tensor) -> Tensor:
    """Values (..., ) of `data` (Z, Y, X) at index points (..., 3) = (x, y, z), zero outside the grid.

    Between the outermost voxel centres and one voxel beyond, values fade linearly to zero.
    """
    shape = torch.tensor(data.shape[::-1], device=points.device)
    base = points.detach().floor()
    weight = points - base
    base = base.long()
    total = torch.zeros_like(points[..., 0])
    for corner in range(8):
        offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=points.device)
        index = base + offset
        inside = ((index >= 0) & (index < shape)).all(-1)
        x, y, z = index.clamp(torch.zeros_like(shape), shape - 1).unbind(-1)
        share = torch.where(offset.bool(), weight, 1 - weight).prod(-1)
        total = total + torch.where(inside, data[z, y, x], data.new_zeros(())) * share
    return total


def march(data: Tensor, index_from_camera: Tensor, camera: Camera, offsets: Tensor, step_mm: float) -> Tensor:
    """Line integrals (B, H, W) through `data` (Z, Y, X), Σ value · step at whole steps beyond an offset.

    `index_from_camera` is (B, 4, 4) and maps mm in the camera frame to (x, y, z) indices; `offsets` (B,) are in mm from
    the source along each ray.
    """
    dtype, device = index_from_camera.dtype, index_from_camera.device
    ray = camera.pixel_positions(dtype, device)
    ray = ray / ray.norm(dim=-1, keepdim=True)  # (H, W, 3)
    data = data.to(dtype)
    last = torch.tensor(data.shape[::-1], dtype=dtype, device=device)
    images = []
    for affine, offset in zip(index_from_camera, offsets.to(index_from_camera), strict=True):
        direction, source = ray @ affine[:3, :3].mT, affine[:3, 3]
        with torch.no_grad():  # which samples can meet the volume at all
            to_faces = torch.stack([-1 - source, last - source]) / direction[..., None, :]  # (H, W, 2, 3)
            enter = to_faces.nan_to_num(-torch.inf).amin(-2).amax(-1)
            leave = to_faces.nan_to_num(torch.inf).amax(-2).amin(-1)
            hit = (leave > enter) & (leave > 0)
            first = max(0, int(((enter[hit] - offset) / step_mm).floor().min())) if hit.any() else 0
            final = int(((leave[hit] - offset) / step_mm).ceil().max()) if hit.any() else -1
        total = torch.zeros(camera.shape, dtype=dtype, device=device)
        for k in range(first, final + 1):
            total = total + trilinear(data, source + (offset + k * step_mm) * direction)
        images.append(total * step_mm)
    return torch.stack(images)
