"""The network that labels bones on coarse voxels: its weights, its input, and its reading of a whole CT."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP, Anatomy
from femoreg_torch.errors import InputError
from femoreg_torch.settings import read_record
from femoreg_torch.volume import Volume, resample_isotropic

_LOWEST_HU, _HIGHEST_HU, _UNIT_HU = -300.0, 1300.0, 400.0  # what the network sees
_LARGEST = 192  # voxels along z that are read at once; a longer CT is read in overlapping parts
_OVERLAP = 48  # voxels that neighbouring parts share; half of them count for each
SHIFTS = ((0, 0, 0), (5, 3, 7), (3, 7, 5), (9, 10, 4))  # voxels along z, y, x, so that its blocks fall elsewhere


@dataclass(frozen=True, eq=False)
class BoneNetwork:
    """A network in evaluation mode. Its classes are the background and the bones of the hip, in order."""

    module: nn.Module  # maps (1, 1, Z, Y, X) to logits (1, classes, Z, Y, X)
    voxel_mm: float  # of the grid that it reads
    multiple: int  # of the sides of what it reads
    anatomy: Anatomy = HIP


def load_bone_network(path: Path | None = None) -> BoneNetwork:
    """The network of a weights file, without a path the shipped one.

    Raises `InputError` for a file that is missing, or holds something else.
    """
    from models.volume_unet import VolumeUNetSettings
    from models.weights import SHIPPED_BONES, read_weights, shipped_weights

    where = str(path or SHIPPED_BONES)
    try:
        weights = shipped_weights(SHIPPED_BONES) if path is None else read_weights(path)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    if weights.kind != "volume_unet" or weights.anatomy != HIP.name:
        raise InputError(
            f"{where}: weights that `femoreg train-segmentation` wrote were expected, found those of a {weights.kind}."
        )
    settings = read_record(VolumeUNetSettings, weights.settings, where)
    if settings.classes != 1 + len(HIP.bones):
        raise InputError(f"{where}: has {settings.classes} classes, but background and bones are {1 + len(HIP.bones)}.")
    try:
        module = settings.build()
        module.load_state_dict({name: tensor.float() for name, tensor in weights.state.items()})
    except (RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{where}: the weights do not fit their network ({reason}).") from error
    if any(not tensor.isfinite().all() for tensor in module.state_dict().values()):
        raise InputError(f"{where}: holds weights that are not finite. Train or copy it anew.")
    return BoneNetwork(module.eval(), settings.voxel_mm, settings.multiple)


def network_input(hu: Tensor) -> Tensor:
    """HU, of any shape, as the network sees them: cut to the range of tissue and bone, in units of 400 HU."""
    return hu.clamp(_LOWEST_HU, _HIGHEST_HU) / _UNIT_HU


def padded_to(values: Tensor, multiple: int) -> Tensor:
    """(Z, Y, X) with air behind its far faces, so that its sides are multiples."""
    missing = [-n % multiple for n in reversed(values.shape)]
    return F.pad(values, [part for n in missing for part in (0, n)], value=_LOWEST_HU / _UNIT_HU)


@torch.inference_mode()
def bone_shares(network: BoneNetwork, ct: Volume) -> tuple[Tensor, Volume]:
    """Probabilities (classes, Z, Y, X) of background and bones, and the CT on the network's voxels.

    The mean over the CT as it is and its mirror image, sides exchanged, each moved by `SHIFTS`. The axes of `ct` run
    along +L, +P, +S, or nearly so. Raises `InputError` for a CT that is smaller than a voxel of the network.
    """
    grid = resample_isotropic(ct, network.voxel_mm)
    exchanged = list(network.anatomy.mirrored_classes)
    starts = _starts(grid.data.shape[0])
    total = torch.zeros((1 + len(network.anatomy.bones), *grid.data.shape))
    for start in starts:
        part = grid.data[start : start + _LARGEST]
        read = torch.zeros((len(total), *part.shape))
        for shift in SHIFTS:
            read += _shares(network, part, shift) + _shares(network, part.flip(2), shift).flip(3)[exchanged]
        read /= 2 * len(SHIFTS)
        first = 0 if start == 0 else _OVERLAP // 2
        last = part.shape[0] if start + _LARGEST >= grid.data.shape[0] else part.shape[0] - _OVERLAP // 2
        total[:, start + first : start + last] = read[:, first:last]
    return total, grid


def _starts(length: int) -> list[int]:
    return [0, *range(_LARGEST - _OVERLAP, max(0, length - _OVERLAP), _LARGEST - _OVERLAP)]


def _shares(network: BoneNetwork, hu: Tensor, shift: tuple[int, int, int]) -> Tensor:
    z, y, x = shift
    moved = F.pad(network_input(hu), (x, 0, y, 0, z, 0), value=_LOWEST_HU / _UNIT_HU)
    logits = network.module(padded_to(moved, network.multiple)[None, None])
    depth, height, width = hu.shape
    result: Tensor = logits[0, :, z : z + depth, y : y + height, x : x + width].softmax(0)
    return result
