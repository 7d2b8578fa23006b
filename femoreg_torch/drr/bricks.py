"""Empty-space skipping: a distance map over bricks of voxels tells how far a packet of rays may leap.

As Šrámek and Kaufman, Fast ray-tracing of rectilinear volume data using distance transforms, IEEE TVCG 6 (2000) 236, by
the chessboard distance; here it is counted in bricks, and rays travel in packets.
"""

from dataclasses import dataclass
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.volume.grid import Volume

BRICK = 4  # voxels along each edge; the kernels find a brick with a shift by 2
SPREAD = 2  # voxels that a ray may stray from the middle of its packet
RIM = 8  # voxels of zeros around the volume: SPREAD twice, plus a brick, so that no ray of a packet leaves the array


@dataclass(frozen=True)
class BrickedVolume:
    """A volume with a rim of zeros, and for every brick the distance to the nearest one that is not empty.

    `padded` is (Z + 2·RIM, …) rounded up to whole bricks. `leap` counts bricks, chessboard metric: 0 where a sample
    within SPREAD of the brick may be non-zero, n where all bricks closer than n are empty.
    """

    padded: NDArray[np.float32]
    leap: NDArray[np.uint8]
    shape: tuple[int, int, int]  # of the volume itself
    version: int


_cache: WeakKeyDictionary[Volume, BrickedVolume] = WeakKeyDictionary()
_one_at_a_time = Lock()  # threads that draw the same volume wait for its bricks


def bricked(volume: Volume) -> BrickedVolume:
    """The bricked form of a volume on the CPU, computed once per volume (and again if its data were changed).

    Raises `InputError` for data made under `torch.inference_mode`, whose changes cannot be noticed.
    """
    if volume.data.is_inference():
        raise InputError("project: this volume was made under torch.inference_mode. Use torch.no_grad there.")
    with _one_at_a_time:
        known = _cache.get(volume)
        if known is None or known.version != volume.data._version:
            known = _build(volume.data.detach().numpy(), volume.data._version)
            _cache[volume] = known
        return known


def _build(data: NDArray[np.float32], version: int) -> BrickedVolume:
    bricks = [-(-(n + 2 * RIM) // BRICK) for n in data.shape]
    padded = np.zeros([b * BRICK for b in bricks], np.float32)
    padded[tuple(slice(RIM, RIM + n) for n in data.shape)] = data
    filled = padded != 0
    for axis in range(3):
        filled = _any_near_bricks(filled, axis)
    depth, height, width = data.shape
    if filled.any():
        leap = ndimage.distance_transform_cdt(~filled, metric="chessboard").clip(0, 255).astype(np.uint8)
    else:
        leap = np.full(filled.shape, 255, np.uint8)
    return BrickedVolume(padded, leap, (depth, height, width), version)


def _any_near_bricks(voxels: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Whether samples within SPREAD of a brick read any voxel that is set, along one axis, for each brick there.

    A sample reads the voxel below it and the one above.
    """
    along = np.moveaxis(voxels, axis, 0)
    rim = np.zeros((BRICK, *along.shape[1:]), bool)
    padded = np.concatenate([rim, along, rim])
    found = np.zeros((len(along) // BRICK, *along.shape[1:]), bool)
    for shift in range(-SPREAD, BRICK + SPREAD + 1):
        found |= padded[BRICK + shift :: BRICK][: len(found)]
    return np.moveaxis(found, 0, axis)
