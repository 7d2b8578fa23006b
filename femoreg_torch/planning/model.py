"""The finite-element model of a femur: its mesh, and stiffness and strength of each element, with cement or without."""

from collections.abc import Sequence
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

    `material` and `fill`, the share of bone, are those of the eighth of an element around each Gauss point (E, 8). With
    one mean for a whole element, bone that fills half of it is as wide as the element at half the stiffness, and bends
    a quarter too stiffly. Properties that vary within elements, over a mesh that does not fit the bone, are those of
    finite cells (Ruess et al. 2012, Biomech Model Mechanobiol 11:425).

    Stiffness and strengths are Hill's average over the bone of an eighth: the mean of Voigt's bound, the arithmetic
    mean, and Reuss's, the harmonic one (R. Hill, Proc. Phys. Soc. A 65 (1952) 349, of stiffness; for strengths it is
    taken over). Voigt's alone joins a thin cortex and the spongy bone beside it side by side in all directions, which
    larger elements do to more of the bone: on real femora 3 mm then bear 7 to 8 % more than 1.5 mm. What is outside
    the bone counts as nothing, or nearly: the average is scaled by the eighth's filling.
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


def make_model(bone: Bone, planning: Planning, size_mm: float) -> Model:
    """The mesh of a bone, with elements of some size. Raises `InputError` if it has more elements than allowed."""
    settings = planning.mesh
    femur = bone.femur
    grid = blocks(femur, size_mm)
    kept_voxels = femur.mask & _above(femur, settings.shaft_mm)
    fill = grid.mean(kept_voxels)
    kept = fill >= settings.least_fill
    pieces, count = ndimage.label(kept)
    if count > 1:
        kept = pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax())
    too_many(int(kept.sum()), settings.most_elements, size_mm)
    mesh = mesh_of(size_mm, kept, grid.lps_from_mm[:3, :3], grid.lps_from_mm[:3, 3])
    ash = mesh.of(grid.mean(np.where(kept_voxels, bone.ash, 0.0)))
    material = Material(*(mesh.of(part) for part in _hill(grid, kept_voxels, _parts(bone.material))))
    fill_at_points = mesh.of(grid.octants(kept_voxels))
    return Model(mesh, grid, kept_voxels, fill_at_points, ash, _never_void(material))


def with_cement(model: Model, bone: Bone, cement: NDArray, settings: CementSettings) -> Material:
    """Properties (E, 8) of the elements with cement in place of bone, mixed at each voxel by its share (X, Y, Z).

    Voxels are then averaged as those of bone are. Elements beyond the box of the cement keep their properties.
    """
    share = np.where(model.voxels, cement, 0.0)
    if not share.any():
        return model.material
    grid, first, box = model.grid.around(share > 0)
    cells = model.mesh.cells - first
    near = ((cells >= 0) & (cells < grid.shape)).all(1)
    values = (settings.modulus_mpa, settings.strength_mpa, settings.strength_mpa)
    mixed = [old[box] + share[box] * (new - old[box]) for old, new in zip(_parts(bone.material), values, strict=True)]
    there = tuple(cells[near].T)
    averaged = _never_void(Material(*(part[there] for part in _hill(grid, model.voxels[box], mixed))))
    changed = [part.copy() for part in _parts(model.material)]
    for part, new in zip(changed, _parts(averaged), strict=True):
        part[near] = new
    return Material(*changed)


def _hill(grid: Blocks, voxels: NDArray[np.bool_], parts: Sequence[Array]) -> list[Array]:
    """Hill's averages (BX, BY, BZ, 8) of properties (X, Y, Z) over the bone in each eighth, times its filling."""
    fill = grid.octants(voxels)
    averages = []
    for part in parts:
        voigt = grid.octants(np.where(voxels, part, 0.0))
        softness = grid.octants(np.divide(1.0, part, where=voxels, out=np.zeros(part.shape)))
        reuss = np.divide(fill**2, softness, where=softness > 0, out=np.zeros_like(fill))
        averages.append((voigt + reuss) / 2)
    return averages


def _never_void(material: Material) -> Material:
    """No eighth (E, 8) without bone is quite void."""
    return Material(*(np.maximum(part, _VOID_SHARE * part.mean(1, keepdims=True)) for part in _parts(material)))


def _parts(material: Material) -> tuple[Array, Array, Array]:
    return material.modulus, material.tension, material.compression


def _above(femur: Femur, below_mm: float) -> NDArray[np.bool_]:
    """Voxels (X, Y, Z) not further than that below the head's centre, along the shaft."""
    height = -femur.frame.proximal @ (femur.frame.head - femur.lps_from_index[:3, 3])
    slopes = femur.frame.proximal @ femur.lps_from_index[:3, :3]
    x, y, z = (np.arange(n) * slope for n, slope in zip(femur.mask.shape, slopes, strict=True))
    return np.asarray(x[:, None, None] + y[None, :, None] + z[None, None, :] + height >= -below_mm)
