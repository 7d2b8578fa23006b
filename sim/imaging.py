"""The six images of one procedure: every view without and with the device."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, invert_rigid, transform_points
from femoreg_torch.volume import Volume, crop, hu_to_attenuation, voxelise_mesh
from sim.acquisition import Acquisition, Procedure
from sim.materials import WATER_PER_BONE, metal_density
from sim.posed_tissue import PosedTissue, take_apart
from sim.xray import XrayModel, areal_densities, fluoroscopy

_ROOM_MM = 45.0  # kept around the field of view, because the femur's turn brings tissue in from outside
_PIXEL_PER_VOXEL = 0.6  # mm on the detector; a voxel's shadow there is some 1.35 times as wide as the voxel
_ASIDE = 2  # coarse pixels to each side that cubic interpolation needs


@dataclass(frozen=True)
class ViewImages:
    """Raw images (H, W) uint16 of one view."""

    anatomy: Tensor
    device: Tensor


def simulate_images(
    ct: Volume,
    labels: Volume,
    femur: tuple[int, ...],
    head_centre: Tensor,
    mesh: trimesh.Trimesh,
    procedure: Procedure,
    camera: Camera,
    settings: Acquisition,
    model: XrayModel,
    generator: torch.Generator,
    report: Callable[[str], None],
) -> list[ViewImages]:
    """Images of all views of a procedure; `report` is told each step before it starts.

    `ct` is in HU, `labels` on the same grid; `femur` holds the labels of the operated femur and `head_centre` (3,) is
    its head in LPS mm; `mesh` is the device in CAD mm.
    """
    poses = procedure.truth.camera_from_pelvis
    report("turning the femur")
    ct, labels = (field_of_view(volume, poses, camera, _ROOM_MM) for volume in (ct, labels))
    tissue = take_apart(ct, labels, femur, procedure.femur_rotation, head_centre)
    del ct, labels
    metal = device_density(mesh, settings.step_mm, settings.device_hu)
    views = []
    for number, (pose, device_pose) in enumerate(zip(poses, procedure.camera_from_device, strict=True), 1):
        report(f"imaging view {number} of {len(poses)}")
        body = tissue_shadow(tissue, pose, camera, settings.step_mm)
        device = areal_densities({"titanium": metal}, device_pose, camera, settings.step_mm)
        anatomy_image = fluoroscopy(body, camera, model, generator)
        views.append(ViewImages(anatomy_image, fluoroscopy(body | device, camera, model, generator)))
    return views


def tissue_shadow(tissue: PosedTissue, camera_from_lps: Tensor, camera: Camera, step_mm: float) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of `water` and `bone` behind a patient."""
    poses = torch.stack([camera_from_lps, camera_from_lps @ tissue.lps_from_femur])
    return shadow(tissue.filled, camera_from_lps, [tissue.bone, tissue.femur], poses, camera, step_mm)


def shadow(
    filled: Volume,
    camera_from_filled: Tensor,
    bones: Sequence[Volume],
    camera_from_bone: Tensor,
    camera: Camera,
    step_mm: float,
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of `water` and `bone` behind densities of `sim.posed_tissue`.

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
    solid = voxelise_mesh(mesh, spacing_mm, hu)
    full = hu_to_attenuation(torch.tensor(float(hu)), -1000.0)
    return solid.with_data(solid.data / full * metal_density(hu))


def field_of_view(volume: Volume, camera_from_lps: Sequence[Tensor] | Tensor, camera: Camera, room_mm: float) -> Volume:
    """The part of a volume that any of the poses (4, 4) shows on the detector, with `room_mm` around it.

    Where it reaches beyond the first or last slice, that slice is repeated: a patient does not end where the CT ends.
    """
    index_from_lps = torch.linalg.inv(volume.lps_from_index)
    last = torch.tensor(volume.data.shape[::-1], dtype=torch.float64) - 1
    corners_index = torch.cartesian_prod(*(torch.tensor([0.0, n], dtype=torch.float64) for n in last.tolist()))
    corners = transform_points(volume.lps_from_index, corners_index)
    rows, columns = camera.shape
    rays = camera.window(slice(0, rows, max(1, rows - 1)), slice(0, columns, max(1, columns - 1))).pixel_positions()
    rays = rays.reshape(-1, 3) / camera.sdd_mm
    seen = []
    for pose in camera_from_lps:
        depth = transform_points(pose, corners)[:, 2]
        frustum = torch.cat([rays * depth.min(), rays * depth.max()])
        seen.append(transform_points(index_from_lps @ invert_rigid(pose), frustum))
    points = torch.cat(seen)
    room = room_mm / torch.tensor(volume.spacing_mm, dtype=torch.float64)
    low = (points.amin(0) - room).floor().int().tolist()
    high = (points.amax(0) + room).ceil().int().tolist()
    part = crop(volume, (low[0], low[1], low[2]), (high[0] + 1, high[1] + 1, high[2] + 1))
    below, above = max(0, -low[2]), max(0, high[2] + 1 - volume.data.shape[0])
    slices = [part.data[:1].expand(below, -1, -1), part.data, part.data[-1:].expand(above, -1, -1)]
    affine = part.lps_from_index.clone()
    affine[:3, 3] -= below * affine[:3, 2]
    return Volume(torch.cat(slices), affine)
