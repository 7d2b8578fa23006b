"""The bricked form of a volume, as in `bricks.py`, made by torch where the volume is. Nothing waits for the device."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from femoreg_torch.drr.bricks import BRICK, RIM, SPREAD
from femoreg_torch.errors import InputError
from femoreg_torch.volume.grid import Volume


@dataclass(frozen=True)
class DeviceBricks:
    """`padded` and `leap` (uint8) as in `BrickedVolume`, on the device of the volume.

    Half-precision data stay as they are, everything else becomes float32.
    """

    padded: Tensor
    leap: Tensor
    version: int


_FARTHEST = 12  # bricks that a leap tells; each takes some calls when a volume is made

_cache: WeakKeyDictionary[Volume, DeviceBricks] = WeakKeyDictionary()


def bricked_on_device(volume: Volume) -> DeviceBricks:
    """The bricked form of a volume, computed once per volume (and again if its data were changed).

    Raises `InputError` for data made under `torch.inference_mode`, whose changes cannot be noticed.
    """
    if volume.data.is_inference():
        raise InputError("project: this volume was made under torch.inference_mode. Use torch.no_grad there.")
    known = _cache.get(volume)
    if known is None or known.version != volume.data._version:
        with torch.no_grad():
            known = _build(volume.data.detach())
        _cache[volume] = known
    return known


def padded_shape(shape: torch.Size) -> tuple[int, int, int]:
    """Size of a volume with its rim, rounded up to whole bricks."""
    depth, height, width = (-(-(n + 2 * RIM) // BRICK) * BRICK for n in shape)
    return depth, height, width


def _build(data: Tensor) -> DeviceBricks:
    version = data._version
    dtype = data.dtype if data.dtype in (torch.float16, torch.bfloat16) else torch.float32
    padded = torch.zeros(padded_shape(data.shape), dtype=dtype, device=data.device)
    padded[tuple(slice(RIM, RIM + n) for n in data.shape)] = data
    return DeviceBricks(padded, _leaps(_filled(padded)), version)


def _filled(padded: Tensor) -> Tensor:
    """Bricks (1, Z, Y, X) that are 1 where a sample within SPREAD of the brick may see a voxel that is not zero."""
    # A sample reads the voxel below it and the one above: from SPREAD before the brick to SPREAD + 1 after it.
    reach = BRICK + 2 * SPREAD + 1
    near = pad((padded != 0).float(), (SPREAD, SPREAD + 1) * 3)[None]
    for window, stride in (
        ((1, 1, reach), (1, 1, BRICK)),
        ((1, reach, 1), (1, BRICK, 1)),
        ((reach, 1, 1), (BRICK, 1, 1)),
    ):
        near = max_pool3d(near, window, stride)
    return near


def _leaps(filled: Tensor) -> Tensor:
    """Chessboard distance (Z, Y, X) of each brick from the nearest filled one, by growing these one brick at a time.

    Those farther off than the farthest that is told are leapt over in several leaps.
    """
    distance = torch.zeros_like(filled)
    # From one end of the volume to the other in any case: to stop when all are reached would mean to wait and look.
    for _ in range(min(max(filled.shape), _FARTHEST)):
        distance += 1 - filled
        filled = max_pool3d(filled, 3, 1, 1)
    return distance[0].to(torch.uint8)
