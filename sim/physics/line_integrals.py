"""Line integrals of density along the rays: mass per area of every material."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import CPU, project
from femoreg_torch.geometry import Camera
from femoreg_torch.volume import Volume, hu_to_attenuation, voxelise_mesh
from femoreg_torch.volume.materials import DENSITIES
from sim.physics.materials import WATER_PER_BONE, metal_density
from sim.physics.mesh_paths import mesh_paths

_PIXEL_PER_VOXEL = 0.6  # mm on the detector; a voxel's shadow there is some 1.35 times as wide as the voxel
_ASIDE = 2  # coarse pixels to each side that cubic interpolation needs


@dataclass(frozen=True, eq=False)
class Solid:
    """Something in the beam that is no patient: a closed surface (mm), full of a material at its density in g/cm³."""

    material: str  # of `femoreg_torch.volume.materials`
    mesh: trimesh.Trimesh
    density: float

    def voxels(self, spacing_mm: float) -> Volume:
        """The same in g/cm³ on cubic voxels."""
        return _filled(self.mesh, spacing_mm, 1000.0, self.density)


def areal_densities(
    densities: Mapping[str, Volume], camera_from_lps: Tensor, camera: Camera, step_mm: float
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² along every ray, for each material.

    `densities` are in g/cm³; `camera_from_lps` (4, 4) maps their common mm space into the camera frame.
    """
    poses = camera_from_lps.expand(1, len(densities), 4, 4)
    integrals = project(list(densities.values()), poses, camera, step_mm, separate=True)[0]
    return dict(zip(densities, integrals / 10, strict=True))  # mm · g/cm³ to g/cm²


def areal_tissue(
    filled: Volume,
    camera_from_filled: Tensor,
    bones: Sequence[Volume],
    camera_from_bone: Tensor,
    camera: Camera,
    step_mm: float,
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of `water` and `bone` of a patient split by `tissue_densities.separate`.

    `camera_from_filled` is (4, 4), `camera_from_bone` (V, 4, 4).
    """
    bone = _interpolated(bones, camera_from_bone, camera, step_mm)
    body = _interpolated([filled], camera_from_filled[None], camera, max(step_mm, min(filled.spacing_mm)))
    return {"water": body - WATER_PER_BONE * bone, "bone": bone}


def _interpolated(volumes: Sequence[Volume], camera_from_volume: Tensor, camera: Camera, step_mm: float) -> Tensor:
    """Mass per area (H, W) in g/cm² of densities in g/cm³; poses (V, 4, 4).

    Where a voxel's shadow is several pixels wide, every few pixels are rendered, about two to a voxel, and the others
    interpolated by cubic convolution (Keys, IEEE Trans Acoust Speech Signal Process 29 (1981) 1153). The coarse image
    reaches beyond the detector by as much as that looks aside.
    """
    voxel_mm = min(min(volume.spacing_mm) for volume in volumes)
    factor = max(1, round(_PIXEL_PER_VOXEL * voxel_mm / max(camera.pixel_mm)))
    if factor == 1:
        return project(volumes, camera_from_volume[None], camera, step_mm)[0] / 10  # mm · g/cm³ to g/cm²
    aside = _ASIDE * factor
    rows, columns = (-(-n // factor) * factor + 2 * aside for n in camera.shape)
    column, row = camera.principal_point_px
    wide = replace(camera, shape=(rows, columns), principal_point_px=(column + aside, row + aside))
    image = project(volumes, camera_from_volume[None], wide.downsampled(factor), step_mm)[None] / 10
    # only with `antialias` are the kernels those of Keys; there is nothing to smooth where pixels become smaller
    fine = F.interpolate(image, size=wide.shape, mode="bicubic", antialias=True)[0, 0]
    return fine[aside : aside + camera.shape[0], aside : aside + camera.shape[1]].contiguous()


def device_density(mesh: trimesh.Trimesh, spacing_mm: float, hu: float) -> Volume:
    """Density in g/cm³ of a device of titanium that a CT would show at `hu`, in CAD space."""
    return _filled(mesh, spacing_mm, hu, metal_density(hu))


def solid_of(mesh: trimesh.Trimesh, material: str) -> Solid:
    """A closed mesh (mm) full of a material at its own density."""
    return Solid(material, mesh, DENSITIES[material])


def _filled(mesh: trimesh.Trimesh, spacing_mm: float, hu: float, density: float) -> Volume:
    """`density` where the mesh is; the HU are those that its share of each voxel is computed with."""
    solid = voxelise_mesh(mesh, spacing_mm, hu)
    full = hu_to_attenuation(torch.tensor(float(hu)), -1000.0)
    return solid.with_data(solid.data / full * density)


def areal_solids(
    solids: Sequence[Solid], camera_from_solids: Tensor, camera: Camera, device: torch.device = CPU
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of each material of solids that share one frame; pose (4, 4). It lies on `device`.

    From the surfaces themselves, not from voxels as registration draws them: a device is imaged as sharply as it is.
    """
    paths = (mesh_paths(solid.mesh, camera_from_solids, camera) for solid in solids)
    # A body that is inside out beside others has no shadow, nor has it any voxels. mm · g/cm³ to g/cm².
    areal = (
        {solid.material: path.clamp_min(0) * (solid.density / 10)} for solid, path in zip(solids, paths, strict=True)
    )
    return {material: mass.to(device) for material, mass in together(*areal).items()}


def together(*areal: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Mass per area of several things in one beam: those of one material add up."""
    total: dict[str, Tensor] = {}
    for masses in areal:
        for material, mass in masses.items():
            total[material] = total[material] + mass if material in total else mass
    return total
