"""What lies within and what beyond the crest of the cortex, where a network is wrong by some millimetres.

A watershed of the CT, darkest first, from what is surely within a bone and surely beyond all (Meyer, Signal Processing
38, 1994): both rise to the crest, and where the cortex has a gap they meet in it. A network takes the foramina of the
sacrum for bone and is sure of it, although they are walled off from the marrow and open to the outside: what cortex
walls off from the main of such a bone is surely of neither side, and the watershed decides.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.segmentation import watershed

from femoreg_torch.segment.boxes import Mask, mean_near, radius, width

_SURELY_WITHIN_MM = (5.0, 3.5, 2.0)  # from the outline found first; the lesser ones in parts that are thinner
_AROUND_MM = 1.5 * _SURELY_WITHIN_MM[0]  # where the thicker parts, and the brightness of the crest, are looked for
_SURELY_BEYOND = 0.08  # share of all bones; what is less is no bone
_CREST_MM = 0.7  # standard deviation of the blur that takes the noise off the crest
_CLEAR_HU = 60.0  # by which a crest that may be trusted over many mm is brighter than what lies within
_WALL_MM = 3.0  # a wall of cortex is half as much brighter than around as the brightest so near it
_WALLED_OFF = 0.1  # of the largest part; smaller ones may be channels
_WALL_VOXELS = 2  # of the wall beside such a part, which are not sure either


@dataclass(frozen=True, eq=False)
class Sides:
    """Where voxels lie, (Z, Y, X) each. The crest itself, and what is far from any outline, is on neither side."""

    within: NDArray[np.uint8]  # 0, or the label of the bone whose inside this is
    beyond: Mask  # and the crest there is brighter than what lies within
    clearly_beyond: Mask  # and so by `_CLEAR_HU`


def sides_of_the_crest(
    found: NDArray[np.uint8],
    bone: NDArray[np.float32],
    hu: NDArray[np.float32],
    spacing: NDArray[np.float64],
    channelled: int,
) -> Sides:
    """The sides around the labels `found` first (Z, Y, X).

    `bone` is the network's share of all bones together, `spacing` (3,) mm along x, y, z, and `channelled` the label of
    the bone whose channels are looked for, or 0.
    """
    around = width(_AROUND_MM, spacing)
    smooth = ndimage.gaussian_filter(hu, _CREST_MM / spacing[::-1])
    sure = _surely_within(found > 0, spacing)
    if channelled:
        sure &= ~_walled_off(sure & (found == channelled), found > 0, smooth, spacing)
    none = bone < _SURELY_BEYOND
    # of either only the border, from which all else is reached
    band = ~none & ~ndimage.binary_erosion(sure) | none & ndimage.binary_dilation(~none)
    nothing = 1 + int(found.max())
    markers = np.where(sure, found, np.where(none, nothing, 0)).astype(np.int32) * band
    side = watershed(smooth, markers, mask=band)
    beyond = side == nothing
    # Where both meet is the crest itself, which its brightness judges. If it is no brighter than what lies within,
    # there is no crest: such is the dense middle of a femoral head of which the network cut off the rest.
    meeting = (side > 0) & ~beyond & ndimage.binary_dilation(beyond)
    higher = mean_near(smooth, meeting, around) - mean_near(smooth, sure, around)
    within = np.where(meeting | beyond, 0, side).astype(np.uint8)
    return Sides(within, beyond & (higher > 0), beyond & (higher > _CLEAR_HU))


def _surely_within(found: Mask, spacing: NDArray[np.float64]) -> Mask:
    """What lies deep within the outline found first."""
    sure = np.zeros(found.shape, np.uint8)
    for depth_mm in _SURELY_WITHIN_MM:
        thinner = ndimage.maximum_filter(sure, width(_AROUND_MM, spacing)) == 0
        sure |= ndimage.minimum_filter(found.astype(np.uint8), width(depth_mm, spacing)) * thinner
    return sure > 0


def _walled_off(inside: Mask, found: Mask, smooth: NDArray[np.float32], spacing: NDArray[np.float64]) -> Mask:
    """What cortex parts from the main of the inside of a bone (Z, Y, X), and the wall beside it.

    Cortex is told by what is around it, so that it does not matter how bright marrow is.
    """
    result = np.zeros(inside.shape, bool)
    if not inside.any():
        return result
    room = radius(_AROUND_MM, spacing)
    [main] = ndimage.find_objects(inside.astype(np.uint8))
    box = tuple(slice(max(0, s.start - r), s.stop + r) for s, r in zip(main, room, strict=True))
    here, values = inside[box], smooth[box]
    usual = mean_near(values, found[box], width(_AROUND_MM, spacing))
    wall = values > (usual + ndimage.maximum_filter(values, width(_WALL_MM, spacing))) / 2
    parts, count = ndimage.label(here & ~wall)
    if not count:
        return result
    sizes = np.bincount(parts.ravel())[1:]
    apart = np.concatenate([[False], sizes < _WALLED_OFF * sizes.max()])[parts]
    apart |= here & wall & ndimage.binary_dilation(apart, iterations=_WALL_VOXELS)
    result[box] = apart
    return result
