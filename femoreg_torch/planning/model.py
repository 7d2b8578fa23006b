"""The finite-element model of a femur: its mesh, and stiffness and strength of each element, with cement or without."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.femur import Femur
from femoreg_torch.planning.laws import Material, bone_material
from femoreg_torch.planning.mesh import Blocks, Mesh, blocks, mesh_of, too_many
from femoreg_torch.planning.settings import CementSettings, Planning

Array = NDArray[np.float64]

_VOID_SHARE = 0.01  # of an element's mean properties: what its eighths without bone have, so that no node hangs free


@dataclass(frozen=True, eq=False)
class Bone:
    """A femur's voxels (X, Y, Z): density and what follows from it, and where cement can go."""

    femur: Femur
    calibration: Calibration
    ash: Array  # g/cc, 0 outside
    material: Material  # MPa, 0 outside
    depth: Array  # mm beneath the surface
    marrow: NDArray[np.bool_]  # spongy bone that may take cement
    pores: Array  # share of each voxel that is no solid bone, 0 outside the marrow: what cement can fill

    def cement_ml(self, cement: NDArray) -> float:
        """Volume of cement, from the share (X, Y, Z) of each voxel's pores that it fills."""
        return float((self.pores * cement).sum()) * self.femur.voxel_ml


@dataclass(frozen=True, eq=False)
class Model:
    """Elements of a femur.

    `material` and `fill`, the share of bone, are means over the eighth of an element around each Gauss point (E, 8),
    where outside the bone counts as nothing, or nearly. With one mean for a whole element, bone that fills half of it
    is as wide as the element at half the stiffness, and bends a quarter too stiffly. Properties that vary within
    elements, over a mesh that does not fit the bone, are those of finite cells (Ruess et al. 2012, Biomech Model
    Mechanobiol 11:425).
    """

    mesh: Mesh
    grid: Blocks
    voxels: NDArray[np.bool_]  # (X, Y, Z) of the bone down to where the shaft is cut
    fill: Array
    ash: Array  # (E,) g/cc
    material: Material

    def cement_share(self, cement: NDArray) -> Array:
        """Share (E, 8) of the elements' eighths that is cement, from the share of each voxel (X, Y, Z)."""
        return self.mesh.of(self.grid.octants(cement))


def make_bone(femur: Femur, calibration: Calibration, planning: Planning) -> Bone:
    """Density, stiffness and strength of each voxel, and the marrow space.

    The marrow space is bone below the density of cortex and as deep as cement is to stay, in one piece with most of it.
    """
    inside = femur.mask
    ash = np.where(inside, calibration.ash_density(femur.hu.astype(float)), 0.0)
    of_all = bone_material(ash, planning.bone)
    material = Material(*(np.where(inside, part, 0.0) for part in (of_all.modulus, of_all.tension, of_all.compression)))
    depth = femur.depth()
    marrow = inside & (depth >= planning.distribution.clearance_mm) & (ash < planning.distribution.cortex_g_cc)
    marrow &= _above(femur, planning.distribution.lowest_mm)
    pieces, count = ndimage.label(marrow)
    if not count:
        raise InputError("CT: no spongy bone in the femur below distribution.cortex_g_cc. Check HU and calibration.")
    marrow = pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax())
    solid = ash / planning.bone.ash_of_apparent / planning.diffusion.solid_g_cc
    pores = np.where(marrow, np.clip(1 - solid, 0.0, 1.0), 0.0)
    return Bone(femur, calibration, ash, material, depth, marrow, pores)


def check_volume(bone: Bone, volume_ml: float) -> None:
    """Raises `InputError` for a volume of cement that is not above 0, or more than the marrow space takes."""
    most = bone.cement_ml(np.ones(bone.pores.shape))
    if not 0 < volume_ml < most:
        raise InputError(
            f"volume_ml: {volume_ml:g} ml of cement, but the marrow space of the {bone.femur.side} femur takes up to "
            f"{most:.1f} ml. Choose less."
        )


def make_model(bone: Bone, planning: Planning, size_mm: float | None = None) -> Model:
    """The mesh of a bone. Raises `InputError` if it has more elements than allowed."""
    settings = planning.mesh
    size = settings.size_mm if size_mm is None else size_mm
    femur = bone.femur
    grid = blocks(femur, size)
    kept_voxels = femur.mask & _above(femur, settings.shaft_mm)
    fill = grid.mean(kept_voxels)
    kept = fill >= settings.least_fill
    pieces, count = ndimage.label(kept)
    if count > 1:
        kept = pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax())
    too_many(int(kept.sum()), settings.most_elements, size)
    mesh = mesh_of(size, kept, grid.lps_from_mm[:3, :3], grid.lps_from_mm[:3, 3])
    ash = mesh.of(grid.mean(np.where(kept_voxels, bone.ash, 0.0)))
    parts = [mesh.of(grid.octants(np.where(kept_voxels, part, 0.0))) for part in _parts(bone.material)]
    never_void = [np.maximum(part, _VOID_SHARE * part.mean(1, keepdims=True)) for part in parts]
    return Model(mesh, grid, kept_voxels, mesh.of(grid.octants(kept_voxels)), ash, Material(*never_void))


def with_cement(model: Model, bone: Bone, cement: NDArray, settings: CementSettings) -> Material:
    """Properties (E, 8) of the elements with cement in place of bone, mixed at each voxel by its share (X, Y, Z)."""
    share = np.where(bone.femur.mask, cement, 0.0)
    values = (settings.modulus_mpa, settings.strength_mpa, settings.strength_mpa)
    changes = [share * (new - old) for new, old in zip(values, _parts(bone.material), strict=True)]
    changed = [
        old + model.mesh.of(model.grid.octants(change))
        for old, change in zip(_parts(model.material), changes, strict=True)
    ]
    return Material(*changed)


def _parts(material: Material) -> tuple[Array, Array, Array]:
    return material.modulus, material.tension, material.compression


def _above(femur: Femur, below_mm: float) -> NDArray[np.bool_]:
    """Voxels (X, Y, Z) not further than that below the head's centre, along the shaft."""
    height = -femur.frame.proximal @ (femur.frame.head - femur.lps_from_index[:3, 3])
    slopes = femur.frame.proximal @ femur.lps_from_index[:3, :3]
    x, y, z = (np.arange(n) * slope for n, slope in zip(femur.mask.shape, slopes, strict=True))
    return np.asarray(x[:, None, None] + y[None, :, None] + z[None, None, :] + height >= -below_mm)
