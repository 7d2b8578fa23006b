"""Bone shapes to build CTs around: signed distances on one grid, from label maps and closed surfaces."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.errors import InputError
from femoreg_torch.files import clear_leftovers, temporary_file
from femoreg_torch.paths import why_unreadable
from femoreg_torch.segment.sphere import refitted_sphere
from femoreg_torch.volume import read_label_map
from sim.patient.around_surfaces.surfaces import read_surfaces
from sim.patient.around_surfaces.voxels import inside_surface
from sim.patient.from_labels.bones import skeleton_from_labels
from sim.patient.skeleton import SIDES

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

STEP_MM = 2.0  # of the grid that the distances stand on
UNIT_MM = 0.25  # of the whole numbers that they are kept as: ±31.75 mm in one byte
_MARGIN_MM = 16.0
_SMOOTH_MM = 1.0  # standard deviation of the blur that takes the voxels off a label map's outlines
_ABOVE_MM = 140.0  # of the spine kept above the sacrum
_SURFACE_VOXEL_MM = 1.0
_SPINE_GAP_MM = 3.0  # the disc between a spine that is set onto a sacrum and the sacrum
_CUT_MM = 6.0  # a femur that the map cuts off is dropped so far above its end, where outlines are often ragged


@dataclass(frozen=True, eq=False)
class BoneShape:
    """Bones of one subject. Node (x, y, z) of a field lies at first + STEP_MM · (x, y, z), LPS mm."""

    name: str
    distance: Tensor  # (6, Z, Y, X) int8, in units of UNIT_MM, negative inside; in the order of the anatomy's bones
    first: Points  # (3,)
    heads: Points  # (2, 3) centres of the femoral heads, left and right
    radii: Points  # (2,) of the heads, mm
    whole_femora: bool  # false where the map cuts them off, so that their ends are no ends


@dataclass(frozen=True, eq=False)
class _Solid:
    """A bone in voxels (X, Y, Z) of `spacing` mm; the first lies at `first`."""

    inside: Mask
    first: Points
    spacing: Points


def read_shape(path: Path, spine: BoneShape | None = None) -> BoneShape:
    """The bones of a label map (NIfTI, by the table that its folder or its name says) or of surfaces (`.npz`).

    `spine` lends its vertebrae, set onto the sacrum, to a map without any. Raises `InputError`.
    """
    solids, cut = (_of_surfaces(path), False) if path.suffix == ".npz" else (_of_labels(path), True)
    if cut:
        solids = _above_the_cut(solids)
    first = np.min([solid.first for solid in solids.values()], 0) - _MARGIN_MM
    last = np.max([s.first + s.spacing * s.inside.shape for s in solids.values()], 0) + _MARGIN_MM
    if cut:  # the last distances then go on below, and the shafts with them
        first[2] = min(solid.first[2] for solid in solids.values())
    if spine is not None:
        last[2] += _ABOVE_MM - _MARGIN_MM
    counts = np.ceil((last - first) / STEP_MM).astype(int)
    fields = {bone: _distance(solid, first, counts) for bone, solid in solids.items()}
    if "vertebrae" not in fields and spine is not None:
        fields["vertebrae"] = _lent_spine(spine, fields, first)
    spheres = np.array([_head(fields, first, side) for side in SIDES])
    far = np.full(tuple(counts[::-1]), 127, np.int8)
    kept = [_bytes(fields[bone]) if bone in fields else far for bone in HIP.bone_names]
    distance = torch.from_numpy(np.stack(kept))
    return BoneShape(path.name.split(".")[0], distance, first, spheres[:, :3], spheres[:, 3], not cut)


def check_shapes(paths: list[Path], cache: Path) -> None:
    """Raises `InputError` for a file that is not there, and not in `cache` either."""
    for path in paths:
        if not _kept(path, cache).is_file() and (why := why_unreadable(path)) is not None:
            raise InputError(f"--shapes: {path}: {why}")


def cached_shapes(paths: list[Path], cache: Path) -> list[BoneShape]:
    """The shapes of these files, from `cache` where it has them; vertebrae are lent by the first that has some."""
    cache.mkdir(parents=True, exist_ok=True)
    clear_leftovers(cache)
    spines: list[BoneShape] = []
    shapes: list[BoneShape] = []
    for path in sorted(paths, key=lambda path: "pelvic_ref" not in path.name):
        kept = _kept(path, cache)
        if not kept.is_file():
            lender = None if "pelvic_ref" in path.name or not spines else spines[len(shapes) % len(spines)]
            _save(read_shape(path, lender), kept)
        shape = _load(kept)
        shapes.append(shape)
        if "pelvic_ref" in path.name:
            spines.append(shape)
    return shapes


def _kept(path: Path, cache: Path) -> Path:
    return cache / f"{path.name.split('.')[0]}.npz"


def _save(shape: BoneShape, path: Path) -> None:
    with temporary_file(path) as part:
        np.savez_compressed(
            part,
            distance=shape.distance.numpy(),
            first=shape.first,
            heads=shape.heads,
            radii=shape.radii,
            whole=shape.whole_femora,
        )


def _load(path: Path) -> BoneShape:
    with np.load(path, allow_pickle=False) as kept:
        distance = torch.from_numpy(kept["distance"])
        return BoneShape(path.stem, distance, kept["first"], kept["heads"], kept["radii"], bool(kept["whole"]))


def _of_surfaces(path: Path) -> dict[str, _Solid]:
    solids = {}
    for bone, mesh in read_surfaces(path).bones.items():
        first = mesh.bounds[0] - 2 * _SURFACE_VOXEL_MM
        counts = np.ceil((mesh.bounds[1] - first) / _SURFACE_VOXEL_MM).astype(int) + 2
        inside = inside_surface(mesh, first, tuple(counts), _SURFACE_VOXEL_MM) > 0
        solids[bone] = _Solid(inside, first, np.full(3, _SURFACE_VOXEL_MM))
    return solids


def _of_labels(path: Path) -> dict[str, _Solid]:
    labels = read_label_map(path)
    if path.name.startswith("pelvic_ref"):  # left and right share an id, and slices are thick
        skeleton, centre, _ = skeleton_from_labels(labels, label_table("pelvic_ref"))
        return {
            bone: _Solid(field.values < 0, field.lo + centre, np.full(3, field.step))
            for bone, field in skeleton.bones.items()
        }
    values = labels.data.numpy().transpose(2, 1, 0)
    spacing, origin = np.array(labels.spacing_mm), labels.lps_from_index[:3, 3].numpy()
    solids = {}
    for bone, (number,) in label_table("autoseg").items():
        parts = sitk.ConnectedComponent(sitk.GetImageFromArray((values == number).astype(np.uint8)))
        inside = sitk.GetArrayFromImage(sitk.RelabelComponent(parts)) == 1  # the largest part
        there = np.argwhere(inside)
        if not len(there):
            raise InputError(f"{path}: holds no voxel of {bone}, label {number}.")
        low, high = there.min(0), there.max(0) + 1
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        solids[bone] = _Solid(inside[box], origin + low * spacing, spacing)
    return solids


def _above_the_cut(solids: dict[str, _Solid]) -> dict[str, _Solid]:
    """Both femora down to the higher one of their ends."""
    lowest = max(solids[f"femur_{side}"].first[2] for side in SIDES) + _CUT_MM

    def raised(solid: _Solid) -> _Solid:
        dropped = max(0, int(np.ceil((lowest - solid.first[2]) / solid.spacing[2])))
        return _Solid(solid.inside[:, :, dropped:], solid.first + solid.spacing * [0, 0, dropped], solid.spacing)

    return {bone: raised(solid) if bone.startswith("femur") else solid for bone, solid in solids.items()}


def _distance(solid: _Solid, first: Points, counts: NDArray[np.int_]) -> NDArray[np.float32]:
    """Signed distance (Z, Y, X), mm, on the grid of STEP_MM that starts at `first`."""
    room = np.ceil(_MARGIN_MM / solid.spacing).astype(int)
    inside = np.pad(solid.inside, [(n, n) for n in room[:2]] + [(0, 0)])
    inside = np.pad(inside, [(0, 0), (0, 0), (room[2], room[2])], mode="edge" if _reaches(solid) else "constant")
    image = sitk.GetImageFromArray(inside.transpose(2, 1, 0).astype(np.uint8))
    image.SetSpacing(solid.spacing.tolist())
    image.SetOrigin((solid.first - room * solid.spacing).tolist())
    field = sitk.SignedMaurerDistanceMap(image, squaredDistance=False, useImageSpacing=True)
    field = sitk.SmoothingRecursiveGaussian(field, _SMOOTH_MM)
    grid = sitk.Image([int(n) for n in counts], sitk.sitkUInt8)
    grid.SetSpacing([STEP_MM] * 3)
    grid.SetOrigin(first.tolist())
    values = sitk.GetArrayFromImage(sitk.Resample(field, grid, sitk.Transform(), sitk.sitkLinear, 1000.0))
    return np.asarray(values, np.float32)


def _reaches(solid: _Solid) -> bool:
    """Whether the lowest slice holds a good part of the bone: a shaft that was cut off, and no tip."""
    areas = solid.inside.sum((0, 1))
    return bool(areas[0] > 0.5 * areas[: max(1, len(areas) // 3)].mean())


def _bytes(field: NDArray[np.float32]) -> NDArray[np.int8]:
    return np.clip(np.round(field / UNIT_MM), -127, 127).astype(np.int8)


def _head(fields: Mapping[str, NDArray[np.float32]], first: Points, side: str) -> Points:
    """Centre and radius (4,) of a femoral head: the part of the femur's surface that lies in the socket."""
    femur, hip = (
        np.argwhere(np.abs(fields[f"{bone}_{side}"]) < 0.5 * STEP_MM)[:, ::-1] * STEP_MM + first
        for bone in ("femur", "hip")
    )
    gap = cKDTree(hip).query(femur)[0]
    return refitted_sphere(femur, gap < np.percentile(gap, 2) + 3)


def _lent_spine(spine: BoneShape, fields: Mapping[str, NDArray[np.float32]], first: Points) -> NDArray[np.float32]:
    """The vertebrae of another subject, moved so that the upper ends of both sacra meet."""
    sacrum, vertebrae = (HIP.bone_names.index(bone) for bone in ("sacrum", "vertebrae"))
    own = _upper_end(fields["sacrum"]) * STEP_MM + first
    other = _upper_end(spine.distance[sacrum].numpy() * UNIT_MM) * STEP_MM + spine.first
    image = sitk.GetImageFromArray(spine.distance[vertebrae].numpy().astype(np.float32) * UNIT_MM)
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin((spine.first + own - other).tolist())
    grid = sitk.Image([int(n) for n in reversed(fields["sacrum"].shape)], sitk.sitkUInt8)
    grid.SetSpacing([STEP_MM] * 3)
    grid.SetOrigin(first.tolist())
    lent = sitk.GetArrayFromImage(sitk.Resample(image, grid, sitk.Transform(), sitk.sitkLinear, 1000.0))
    for bone in ("sacrum", "hip_left", "hip_right"):
        lent = np.maximum(lent, _SPINE_GAP_MM - fields[bone])
    return np.asarray(lent, np.float32)


def _upper_end(field: NDArray[np.floating]) -> Points:
    """Index (3,) of the middle of a sacrum's uppermost centimetre, near its middle from left to right."""
    points = np.argwhere(field < 0)[:, ::-1].astype(float)
    middle = points[np.abs(points[:, 0] - np.median(points[:, 0])) < 15 / STEP_MM]
    top: Points = middle[middle[:, 2] > middle[:, 2].max() - 10 / STEP_MM].mean(0)
    return top
