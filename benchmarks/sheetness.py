"""Bones of a CT without a network and without a prior of their shape, in the manner of Krčah et al., to compare with.

Krčah, Székely, Blanc, "Fully automatic and fast segmentation of the femur bone from 3D-CT images with no shape prior",
ISBI 2011: sheetness at several scales (Descoteaux et al., MICCAI 2005), a graph cut on it, and bones parted where only
a thin bridge joins them. Sheetness is ITK's objectness measure; the cut is SciPy's maximum flow on the voxels that
neither HU nor sheetness decide alone. Which part is which bone is told from where it lies.
"""

import numpy as np
import SimpleITK as sitk
import torch
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from femoreg_torch.volume import Volume, resample_isotropic

VOXEL_MM = 1.5
_SCALES_MM = (0.75, 1.5)  # of the Hessian
_SHARPEN_MM, _SHARPEN = 1.0, 10.0  # unsharp mask of the paper
_BONE_HU, _FAT_HU = 400.0, -50.0  # bone above with positive sheetness, no bone below: the paper's
_GAMMA_HU = 100.0  # of the Hessian, below which there is noise; sheetness is between −1 and 1
_SIGMA = 0.2  # of differences of sheetness
_WEIGHT = 1000  # of an edge, as flows are whole numbers
_REACH_MM = 8.0  # beyond this from sure bone nothing is bone
_BRIDGES_MM = (1.5, 3.0, 4.5)  # half widths of the bridges that are cut, until the femora come off
_LEAST_ML = 20.0

Mask = NDArray[np.bool_]
Array = NDArray[np.float32]


def sheetness_labels(ct: Volume) -> NDArray[np.uint8]:
    """Labels (Z, Y, X) on the grid of `ct`, 1 + the number of the bone; none where the femora do not come off."""
    grid = resample_isotropic(ct, VOXEL_MM)
    hu = grid.data.numpy()
    bone = _cut(hu, sheetness(hu))
    labels = _named(bone)
    fine = F.interpolate(torch.from_numpy(labels)[None, None].float(), ct.data.shape, mode="nearest-exact")
    result: NDArray[np.uint8] = fine[0, 0].to(torch.uint8).numpy()
    return result


def sheetness(hu: Array) -> Array:
    """Between −1 (dark sheet) and 1 (bright sheet) at each voxel of VOXEL_MM."""
    image = sitk.GetImageFromArray(np.clip(hu, -200, 1500).astype(np.float32))
    image.SetSpacing([VOXEL_MM] * 3)
    sharp = image + _SHARPEN * (image - sitk.SmoothingRecursiveGaussian(image, _SHARPEN_MM))
    best: Array = np.zeros(hu.shape, np.float32)
    for scale in _SCALES_MM:
        smooth = sitk.SmoothingRecursiveGaussian(sharp, scale)
        for sign, bright in ((1, True), (-1, False)):
            found = sitk.ObjectnessMeasure(
                smooth,
                alpha=0.5,
                beta=0.5,
                gamma=_GAMMA_HU,
                objectDimension=2,
                brightObject=bright,
                scaleObjectnessMeasure=False,
            )
            value = sign * sitk.GetArrayFromImage(found).astype(np.float32)
            best = np.where(np.abs(value) > np.abs(best), value, best)
    return best


def _cut(hu: Array, sheets: Array) -> Mask:
    """Bone by the minimum cut between sure bone and what is surely none."""
    sure = (hu > _BONE_HU) & (sheets > 0)
    parts, count = ndimage.label(sure)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    sure = (sizes * VOXEL_MM**3 > 500)[parts]
    none = (hu < _FAT_HU) | (ndimage.distance_transform_edt(~sure) * VOXEL_MM > _REACH_MM)
    none &= ~ndimage.binary_fill_holes(ndimage.binary_closing(sure, iterations=2))
    none &= ~sure
    open_voxels = ~sure & ~none
    number = np.zeros(hu.shape, np.int32)
    number[open_voxels] = 2 + np.arange(int(open_voxels.sum()), dtype=np.int32)
    number[sure], number[none] = 0, 1
    rows, columns, flows = [], [], []
    for axis in range(3):
        here, there = (np.take(number, range(a, hu.shape[axis] - 1 + a), axis).ravel() for a in (0, 1))
        s_here, s_there = (np.take(sheets, range(a, hu.shape[axis] - 1 + a), axis).ravel() for a in (0, 1))
        both = (here != there) & ((here > 1) | (there > 1))
        step = s_here[both] - s_there[both]
        likeness = np.exp(-np.abs(step) / _SIGMA)
        # to leave bone for less sheetness costs little; against the slope it costs all (the paper's asymmetric edge)
        out = np.where(step > 0, likeness, 1.0)
        back = np.where(step < 0, likeness, 1.0)
        rows += [here[both], there[both]]
        columns += [there[both], here[both]]
        flows += [out, back]
    capacity = (1 + _WEIGHT * np.concatenate(flows)).astype(np.int32)
    count = 2 + int(open_voxels.sum())
    graph = sparse.coo_matrix((capacity, (np.concatenate(rows), np.concatenate(columns))), (count, count)).tocsr()
    graph.data = graph.data.astype(np.int32)
    left = graph - maximum_flow(graph, 0, 1).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = np.zeros(count, bool)
    reached[breadth_first_order(left, 0, return_predecessors=False)] = True
    result: Mask = reached[number]
    return ndimage.binary_fill_holes(result)


def _named(bone: Mask) -> NDArray[np.uint8]:
    """Bones by place: femora are the two lowest large parts once thin bridges are cut; of the rest, left and right."""
    labels = np.zeros(bone.shape, np.uint8)
    voxels = _LEAST_ML * 1000 / VOXEL_MM**3
    depth = ndimage.distance_transform_edt(np.pad(bone, 1, mode="edge"))[1:-1, 1:-1, 1:-1] * VOXEL_MM
    for bridge in _BRIDGES_MM:
        parts, count = ndimage.label(depth > bridge)
        sizes = np.bincount(parts.ravel(), minlength=count + 1)
        large = [n for n in range(1, count + 1) if sizes[n] > voxels]
        lowest = {n: int(np.flatnonzero((parts == n).any((1, 2)))[0]) for n in large}
        bottom = [n for n in large if lowest[n] <= min(lowest.values(), default=0) + 30 / VOXEL_MM]
        tops = {n: int(np.flatnonzero((parts == n).any((1, 2)))[-1]) for n in bottom}
        height = bone.shape[0]
        femora = [n for n in bottom if tops[n] < 0.75 * height]
        if len(femora) == 2:
            break
    else:
        return labels
    markers = np.zeros(bone.shape, np.int32)
    middle = np.mean([ndimage.center_of_mass(parts == n)[2] for n in femora])
    for n in femora:
        side = "left" if ndimage.center_of_mass(parts == n)[2] > middle else "right"
        markers[parts == n] = 1 + HIP.bone_names.index(f"femur_{side}")
    for n in large:
        if n not in femora:
            x = ndimage.center_of_mass(parts == n)[2]
            if abs(x - middle) * VOXEL_MM < 25:  # hip bones and sacrum in one, or the sacrum
                index = np.argwhere(parts == n)
                off = (index[:, 2] - middle) * VOXEL_MM
                back = index[:, 1] > np.percentile(index[:, 1], 50)
                names = np.where(off > 0, 1 + HIP.bone_names.index("hip_left"), 1 + HIP.bone_names.index("hip_right"))
                names[(np.abs(off) < 45) & back] = 1 + HIP.bone_names.index("sacrum")
                markers[tuple(index.T)] = names
            else:
                markers[parts == n] = 1 + HIP.bone_names.index("hip_left" if x > middle else "hip_right")
    nearest = ndimage.distance_transform_edt(markers == 0, return_distances=False, return_indices=True)
    labels[bone] = markers[tuple(nearest)][bone]
    return labels
