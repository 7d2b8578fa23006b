"""A femur cut out of its CT: grey values, mask, and the frame of head, shaft and neck.

Arrays of this room are (X, Y, Z), indexed [x, y, z] as the CT's index axes; `Volume` keeps (Z, Y, X).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SPECK_SHARE = 0.01  # of the label: more, apart from the rest, is a second bone
_HOLE_SHARE = 0.02  # of the label: more, enclosed in slices, is marrow that was left out
_GAP_MM = 2.0  # gaps of a cortex so wide are closed before it is asked whether it is a shell
_MARGIN_VOXELS = 4  # around the bone
SHAFT_FROM_MM = 70.0  # below the head's centre: there the shaft is a tube (about 10 mm below the lesser trochanter)
_LEAST_SHAFT_MM = 20.0  # of such a tube, to know its axis
_SHAFT_MM = 80.0  # of it taken for the axis: further down the femur bows


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a femur is, in LPS mm: unit vectors (3,), right-angled, and the centre and radius of the head."""

    head: Array
    head_radius: float
    proximal: Array  # along the shaft
    lateral: Array  # in the plane of shaft and head
    posterior: Array
    shaft: Array  # the point of the shaft's axis at the level of the head's centre

    @property
    def neck(self) -> Array:
        """Unit vector from the head towards the shaft's axis, 45° down to it; the planner's first guess of a path."""
        axis = self.lateral - self.proximal
        return np.asarray(axis / np.linalg.norm(axis))


@dataclass(frozen=True, eq=False)
class Femur:
    """One femur in a box of its CT."""

    side: Side
    hu: NDArray[np.float32]  # (X, Y, Z)
    mask: Mask  # (X, Y, Z), one component without holes
    lps_from_index: Array  # (4, 4), of this box
    corner: tuple[int, int, int]  # of the box in the CT, voxels
    frame: Frame

    @property
    def spacing(self) -> Array:
        """Voxel edges (3,), mm."""
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel."""
        return float(np.prod(self.spacing)) / 1000

    @property
    def axes(self) -> Array:
        """Unit vectors of the index axes in LPS, as columns (3, 3)."""
        return np.asarray(self.lps_from_index[:3, :3] / self.spacing)

    def points(self, index: NDArray[np.int64]) -> Array:
        """Voxel centres (N, 3), LPS mm, of indices (N, 3)."""
        return np.asarray(index @ self.lps_from_index[:3, :3].T + self.lps_from_index[:3, 3])

    def index(self, points: Array) -> Array:
        """Fractional indices (..., 3) of points (..., 3) in LPS mm."""
        return np.asarray((points - self.lps_from_index[:3, 3]) @ np.linalg.inv(self.lps_from_index[:3, :3]).T)

    def depth(self) -> Array:
        """mm from the surface (X, Y, Z), above 0 within the bone and below 0 outside; 0 half-way between voxels.

        Where the CT cuts the shaft there is no surface.
        """
        padded = np.pad(self.mask, ((0, 0), (0, 0), (1, 1)), mode="edge")
        inside, outside = (self._to_surface(of)[:, :, 1:-1] for of in (padded, ~padded))
        return np.where(self.mask, inside, -outside)

    def _to_surface(self, mask: NDArray[np.bool_]) -> Array:
        """mm from voxels of a mask to where the nearest voxel beside it begins: half an edge before its centre.

        Half of which edge follows from the direction it lies in; slices may be thicker than their pixels.
        """
        far, nearest = ndimage.distance_transform_edt(mask, sampling=self.spacing, return_indices=True)
        steps = (nearest - np.indices(mask.shape)) * self.spacing[:, None, None, None]
        halves = np.linalg.norm(steps * self.spacing[:, None, None, None], axis=0) / 2
        return np.asarray(far - halves / np.maximum(far, np.finfo(float).tiny))


def cut_out(ct: Volume, labels: Volume, bone: int, head: Array, side: Side, shaft_mm: float) -> Femur:
    """The femur with the id `bone` in `labels`, on the grid of the `ct`, kept to `shaft_mm` below the head and more.

    `head` is the centre of its head (3,), LPS mm. Raises `InputError` if the label is empty, in pieces or hollow, does
    not hold the head's centre, is cut off by the CT elsewhere than at the shaft, or too short.
    """
    mask = np.ascontiguousarray((labels.data.numpy() == bone).transpose(2, 1, 0))
    if not mask.any():
        raise InputError(f"label map: no voxel of the {side} femur. Check its id under `ct.bones`.")
    box = ndimage.find_objects(mask.astype(np.int8))[0]
    _check_cut(box, mask.shape, side)
    low = [max(part.start - _MARGIN_VOXELS, 0) for part in box]
    high = [min(part.stop + _MARGIN_VOXELS, size) for part, size in zip(box, mask.shape, strict=True)]
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    whole = _one_piece(mask[box], ct.lps_from_index.numpy(), side)
    hu = np.ascontiguousarray(ct.data.numpy().transpose(2, 1, 0)[box]).astype(np.float32)
    affine = ct.lps_from_index.numpy().copy()
    affine[:3, 3] += affine[:3, :3] @ np.array(low, float)
    frame = _frame(whole, affine, np.asarray(head, float), side, shaft_mm)
    if low[2] == 0:
        _check_shaft_end(whole[:, :, 0], affine, frame, side, shaft_mm)
    return Femur(side, hu, whole, affine, (low[0], low[1], low[2]), frame)


def _check_cut(box: tuple[slice, ...], shape: tuple[int, ...], side: Side) -> None:
    names = (("right", "left"), ("front", "back"))
    sides = [(box[n].start == 0, box[n].stop == shape[n], names[n]) for n in range(2)]
    for first, last, (low, high) in sides:
        if first or last:
            raise InputError(
                f"label map: the {side} femur is cut off by the CT on the {low if first else high}. Only the end of "
                "its shaft may be missing; use a larger scan."
            )
    if box[2].stop == shape[2]:
        raise InputError(f"label map: the {side} femur is cut off by the CT at the top. Use a scan of the whole head.")


def _check_shaft_end(end: Mask, affine: Array, frame: Frame, side: Side, shaft_mm: float) -> None:
    """Raises `InputError` if the last slice cuts the shaft of a bent leg askew."""
    places = np.argwhere(end)
    if not len(places):
        return
    points = np.c_[places, np.zeros(len(places))] @ affine[:3, :3].T + affine[:3, 3]
    highest = float(((points - frame.head) @ frame.proximal).max())
    if highest > -shaft_mm:
        raise InputError(
            f"CT: its last slice cuts the {side} femur askew, on one side {-highest:.0f} mm below the centre of its "
            f"head, but {shaft_mm:.0f} mm are needed all around. Use a longer scan."
        )


def _one_piece(mask: Mask, affine: Array, side: Side) -> Mask:
    """The largest component, holes filled, if what it leaves out and fills is little.

    Holes count with gaps of the bone around them closed: a label of the cortex alone has gaps where that is thin.
    """
    pieces, count = ndimage.label(mask)
    sizes = np.bincount(pieces.ravel())[1:]
    largest = int(sizes.argmax()) + 1
    if count > 1 and np.delete(sizes, largest - 1).max() > _SPECK_SHARE * sizes.sum():
        raise InputError(
            f"label map: the {side} femur has {count} pieces, the second holds {np.sort(sizes)[-2]} voxels. Keep one."
        )
    kept = pieces == largest
    closed = _closed(kept, np.linalg.norm(affine[:3, :3], axis=0))
    holes = int((_filled(closed) & ~closed).sum())
    if holes > _HOLE_SHARE * kept.sum():
        raise InputError(
            f"label map: the {side} femur has holes of {holes} voxels ({100 * holes / kept.sum():.0f} % of it). Fill "
            "them: marrow belongs to the label."
        )
    return _filled(kept)


def _filled(mask: Mask) -> Mask:
    """With what is enclosed in each slice."""
    return np.stack([ndimage.binary_fill_holes(mask[:, :, z]) for z in range(mask.shape[2])], axis=2)


def _closed(mask: Mask, spacing: Array) -> Mask:
    """Gaps up to `_GAP_MM` within slices closed."""
    reach = np.ceil(_GAP_MM / 2 / spacing[:2]).astype(int)
    ball = np.ones((2 * reach[0] + 1, 2 * reach[1] + 1, 1), bool)
    padded = np.pad(mask, [(int(reach[0]),) * 2, (int(reach[1]),) * 2, (0, 0)])
    closed = ndimage.binary_closing(padded, ball)
    return np.asarray(closed[reach[0] : -reach[0], reach[1] : -reach[1]])


def _frame(mask: Mask, affine: Array, head: Array, side: Side, shaft_mm: float) -> Frame:
    index = np.linalg.inv(affine[:3, :3]) @ (head - affine[:3, 3])
    nearest = tuple(np.round(index).astype(int))
    if any(n < 0 or n >= size for n, size in zip(nearest, mask.shape, strict=True)) or not mask[nearest]:
        raise InputError(f"landmarks: the centre of the {side} femoral head does not lie in the label of that femur.")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    offsets = [(np.arange(size) - at) * edge for size, at, edge in zip(mask.shape, index, spacing, strict=True)]
    squared = sum(along**2 for along in np.ix_(*offsets))  # mm², of all voxels from the centre itself, not its voxel
    radius = float(np.sqrt(np.min(squared, where=~mask, initial=np.inf)))
    points = np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3] - head
    proximal = affine[:3, 2] / spacing[2]
    for _ in range(5):  # slices square to the axis follow from the axis
        along = points @ proximal
        lowest = float(along.min())
        end = max(lowest, -SHAFT_FROM_MM - _SHAFT_MM)
        if lowest > -SHAFT_FROM_MM - _LEAST_SHAFT_MM:
            raise _too_short(side, lowest, shaft_mm)
        within = (along < -SHAFT_FROM_MM) & (along > end + 5)
        level = np.floor(along[within] / 2).astype(int)
        level -= level.min()
        counts = np.maximum(np.bincount(level), 1)
        centres = np.stack([np.bincount(level, weights=c) / counts for c in points[within].T], axis=1)
        centres = centres[np.bincount(level) > 0]
        middle = centres.mean(0)
        axis = np.linalg.svd(centres - middle)[2][0]
        proximal = axis if axis @ proximal > 0 else -axis
    lowest = float((points @ proximal).min())
    if lowest > -shaft_mm:
        raise _too_short(side, lowest, shaft_mm)
    shaft = middle - proximal * (middle @ proximal)  # its axis at the head's level
    lateral = shaft / np.linalg.norm(shaft)
    # +L × … : prox × lateral points back on the left, where lateral is +L, and to the front on the right
    posterior = np.cross(proximal, lateral) * (1 if side == "left" else -1)
    return Frame(head, radius, proximal, lateral, posterior, head + shaft)


def _too_short(side: Side, lowest: float, shaft_mm: float) -> InputError:
    return InputError(
        f"CT: its label shows the {side} femur to {-lowest:.0f} mm below the centre of its head, but "
        f"{max(shaft_mm, SHAFT_FROM_MM + _LEAST_SHAFT_MM):.0f} mm are needed. Use a longer scan, or label more of it."
    )
