"""A small left hip of simple solids: a femoral head with its shaft in a socket, whose true labels are known."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from femoreg_torch.segment import BoneNetwork
from femoreg_torch.segment.network import SHIFTS
from femoreg_torch.volume import Volume, axis_aligned

HIP_LEFT, FEMUR_LEFT = 1 + HIP.bone_names.index("hip_left"), 1 + HIP.bone_names.index("femur_left")
HEAD, RADIUS_MM, GAP_MM = np.array([60.0, 5.0, 40.0]), 23.0, 3.0
_PART_MM = 0.75  # about so fine are the solids sampled
_LOW, _HIGH = np.array([0.0, -50.0, -60.0]), np.array([120.0, 60.0, 110.0])


def hip_scene(spacing: tuple[float, float, float], metal: bool = False) -> tuple[Volume, NDArray[np.uint8]]:
    """CT in HU (cortex of 1000 HU, 2 mm thick, around marrow of 60 HU in muscle of 50 HU) and its true labels.

    A voxel holds the mean over its width, as in a scanner, and the label of its larger part.
    """
    parts = [max(1, round(s / _PART_MM)) for s in spacing]
    counts = np.round((_HIGH - _LOW) / spacing).astype(int)
    axes = [_LOW[k] + spacing[k] * (np.arange(counts[k] * parts[k]) + 0.5) / parts[k] for k in range(3)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    off = np.stack([x, y, z], -1) - HEAD
    from_head = np.linalg.norm(off, axis=-1)
    beside = off + np.array([0, 0, 1]) * np.clip(-off[..., 2:], 0, 200)  # a shaft straight down from the head
    femur = np.minimum(from_head - RADIUS_MM, np.linalg.norm(beside[..., :2], axis=-1) - 14)
    femur[off[..., 2] > 0] = from_head[off[..., 2] > 0] - RADIUS_MM
    socket = np.maximum(from_head - RADIUS_MM - GAP_MM - 9, RADIUS_MM + GAP_MM - from_head)
    socket = np.maximum(socket, -off[..., 2] + 2)
    hu = np.full(x.shape, 50.0)
    labels = np.zeros(x.shape, np.uint8)
    for distance, number in ((socket, HIP_LEFT), (femur, FEMUR_LEFT)):
        hu[distance < 0] = 1000
        hu[distance < -2] = 60
        labels[distance < 0] = number
    if metal:
        hu[np.linalg.norm(beside[..., :2], axis=-1) < 4] = 3071
        hu[off[..., 2] > 15] = np.where(labels > 0, hu, 50)[off[..., 2] > 15]
    hu[y < _LOW[1] + 8] = -1000
    width = (parts[2], parts[1], parts[0])
    hu = _mean(hu, width)
    labels = sum(n * (_mean(labels == n, width) > 0.5) for n in (HIP_LEFT, FEMUR_LEFT)).astype(np.uint8)
    hu += np.random.default_rng(0).normal(0, 15, hu.shape)
    first = _LOW + np.array(spacing) / 2
    affine = axis_aligned(spacing, (first[0], first[1], first[2]))
    return Volume(torch.from_numpy(hu.astype(np.float32)), affine), labels


def _mean(values: NDArray[np.generic], width: tuple[int, int, int]) -> NDArray[np.float64]:
    """Means over so many values along each axis."""
    shape = [n for count, w in zip(values.shape, width, strict=True) for n in (count // w, w)]
    return values.reshape(shape).mean((1, 3, 5))


def shares_of(labels: NDArray[np.uint8], spacing: tuple[float, float, float], voxel_mm: float = 3.0) -> Tensor:
    """What a network that is right on coarse voxels gives: shares (classes, z, y, x), blurred by one of its voxels."""
    truth = F.one_hot(torch.from_numpy(labels).long(), 1 + len(HIP.bones)).movedim(-1, 0).float()
    size = [int(n * s / voxel_mm) for n, s in zip(labels.shape, reversed(spacing), strict=True)]
    coarse = F.interpolate(truth[None], size, mode="area")
    return F.avg_pool3d(F.pad(coarse, (1,) * 6, mode="replicate"), 3, 1)[0] * 0.5 + coarse[0] * 0.5


class Answer(nn.Module):
    """A network that gives the same shares whatever it reads: moved as that is, and mirrored every second time."""

    def __init__(self, shares: Tensor) -> None:
        super().__init__()
        self.shares, self.calls = shares, 0

    def forward(self, volume: Tensor) -> Tensor:
        shares = self.shares.flip(3)[list(HIP.mirrored_classes)] if self.calls % 2 else self.shares
        low = SHIFTS[self.calls // 2 % len(SHIFTS)]
        self.calls += 1
        result = torch.full((1, len(shares), *volume.shape[2:]), -20.0)
        result[0, 0] = 20.0
        z, y, x = (slice(a, a + n) for a, n in zip(low, shares.shape[1:], strict=True))
        result[0, :, z, y, x] = shares.clamp(min=1e-6).log()
        return result


def answering(shares: Tensor, voxel_mm: float = 3.0) -> BoneNetwork:
    """A network whose answer is known."""
    return BoneNetwork(Answer(shares), voxel_mm, 16)


def dice(found: Tensor, truth: NDArray[np.uint8], number: int) -> float:
    one, other = found.numpy() == number, truth == number
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))
