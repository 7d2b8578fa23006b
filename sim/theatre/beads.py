"""Metal beads of a simulated cadaver: where they sit, how a CT shows them, and their mass in the beam.

As in the paper's cadaver study (section III-B): seven beads of 1 mm in the femoral head and near the trochanter, five
of 1.5 mm on the surface of the device. The paper does not say what metal; stainless steel is chosen here.
"""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, transform_points
from femoreg_torch.volume import Volume
from femoreg_torch.volume.materials import DENSITIES, material_hu
from sim.physics.spheres import areal_spheres

METAL = "steel"
_HEAD_MM, _TROCHANTER_MM = 14.0, 22.0  # how far from the head's centre, and from the entry point, beads sit
_DEEP_MM = 3.0  # below the surface of the bone
_APART_MM = 7.0  # between two beads at least
_TRIES = 20_000
_SURFACE, _DENSE = 600, 100_000  # candidates on the device; points that stand for its surface
_TOUCHING = 0.9  # radii from a bead's centre to the nearest surface at least
_FINE_MM = 0.1  # grid on which a bead is blurred for the CT
_HIGHEST_HU = 3071  # a CT of 12 bits


@dataclass(frozen=True, eq=False)
class PlacedBeads:
    """Beads in one object, mm in its space."""

    points: Tensor  # (N, 3) float64
    diameter_mm: float

    def areal(self, camera_from_object: Tensor, camera: Camera) -> dict[str, Tensor]:
        """Mass per area (H, W) in g/cm², by material."""
        centres = transform_points(camera_from_object, self.points)
        return {METAL: areal_spheres(centres, self.diameter_mm / 2, DENSITIES[METAL], camera)}


def femur_beads(
    labels: Volume,
    femur: tuple[int, ...],
    head: Tensor,
    entry_point: Tensor,
    counts: tuple[int, int],
    diameter_mm: float,
    generator: torch.Generator,
) -> PlacedBeads:
    """Beads within the bone, so many about the centre of the head (3,) and so many near the entry point (3,), LPS mm.

    Raises `InputError` if there is no room for them.
    """
    mask = torch.isin(labels.data, torch.tensor(femur, dtype=labels.data.dtype)).numpy()
    deep = torch.from_numpy(ndimage.distance_transform_edt(mask, sampling=labels.spacing_mm[::-1]) >= _DEEP_MM)
    index_from_lps = torch.linalg.inv(labels.lps_from_index)
    size = torch.tensor(labels.data.shape[::-1])
    found: list[Tensor] = []
    for middle, reach, count in ((head, _HEAD_MM, counts[0]), (entry_point, _TROCHANTER_MM, counts[1])):
        wanted = len(found) + count
        for _ in range(_TRIES):
            if len(found) == wanted:
                break
            offset = (2 * torch.rand(3, generator=generator, dtype=torch.float64) - 1) * reach
            point = middle + offset
            index = transform_points(index_from_lps, point[None])[0].round().long()
            if offset.norm() > reach or (index < 0).any() or (index >= size).any():
                continue
            x, y, z = index.tolist()
            if deep[z, y, x] and all((point - other).norm() >= _APART_MM for other in found):
                found.append(point)
        if len(found) < wanted:
            raise InputError(f"beads: no room for {count} beads in the bone within {reach:g} mm. Take fewer.")
    return PlacedBeads(torch.stack(found), diameter_mm)


def device_beads(mesh: trimesh.Trimesh, count: int, diameter_mm: float, seed: int) -> PlacedBeads:
    """Beads glued on the surface of a device, evenly spread: each as far from the others as it can be."""
    places, faces = trimesh.sample.sample_surface(mesh, _SURFACE, seed=seed)
    centres = np.asarray(places) + mesh.face_normals[faces] * diameter_mm / 2
    surface = cKDTree(np.asarray(trimesh.sample.sample_surface(mesh, _DENSE, seed=seed)[0]))
    free = surface.query(centres)[0] > _TOUCHING * diameter_mm / 2  # or it would stick into another part
    centres = centres[free]
    if len(centres) < count:
        raise InputError(f"beads: no room for {count} beads of {diameter_mm:g} mm on the device. Take fewer.")
    chosen = [0]
    while len(chosen) < count:
        distances = np.linalg.norm(centres[:, None] - centres[chosen], axis=2).min(1)
        chosen.append(int(distances.argmax()))
    return PlacedBeads(torch.from_numpy(centres[chosen]), diameter_mm)


def ct_with_beads(ct: Volume, beads: PlacedBeads, blur_mm: float) -> Volume:
    """A CT in HU as a scanner whose blur is a Gaussian of this deviation shows it with beads; clipped at 3071 HU."""
    data = ct.data.clone()
    index_from_lps = torch.linalg.inv(ct.lps_from_index)
    spacing = np.array(ct.spacing_mm)
    reach = beads.diameter_mm / 2 + 4 * blur_mm + spacing
    half = np.ceil(reach / spacing).astype(int)
    parts = np.ceil(spacing / _FINE_MM).astype(int)
    for point in beads.points:
        index = transform_points(index_from_lps, point[None])[0].numpy()
        low = np.round(index).astype(int) - half
        high = low + 2 * half + 1
        if (low < 0).any() or (high > np.array(data.shape[::-1])).any():
            raise InputError("beads: one lies at the edge of the CT.")
        axes = [
            (np.arange(a * p, b * p) + 0.5) / p - 0.5 - i for a, b, p, i in zip(low, high, parts, index, strict=True)
        ]
        x, y, z = (axis * s for axis, s in zip(axes, spacing, strict=True))
        distance = np.sqrt(x[None, None, :] ** 2 + y[None, :, None] ** 2 + z[:, None, None] ** 2)
        step = spacing / parts
        share = ((beads.diameter_mm / 2 - distance) / step.mean() + 0.5).clip(0, 1)
        share = ndimage.gaussian_filter(share, (blur_mm / step)[::-1])
        nz, ny, nx = (int(n) for n in (high - low)[::-1])
        pz, py, px = (int(n) for n in parts[::-1])
        share = share.reshape(nz, pz, ny, py, nx, px).mean((1, 3, 5))
        window = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
        part = data[window]
        data[window] = part + torch.from_numpy(share).to(part.dtype) * (material_hu(METAL) - part)
    return ct.with_data(data.clamp_max(_HIGHEST_HU))
