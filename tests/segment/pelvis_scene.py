"""A pelvis of simple solids with both femora, whose true labels are known."""

import numpy as np
import torch
from numpy.typing import NDArray

from femoreg_torch.anatomy import HIP
from femoreg_torch.volume import Volume, axis_aligned

HEADS = {"left": np.array([85.0, 0.0, 0.0]), "right": np.array([-85.0, 0.0, 0.0])}
RADIUS_MM, GAP_MM, SPACING_MM = 23.0, 3.0, 2.0
_LOW, _HIGH = np.array([-150.0, -70.0, -100.0]), np.array([150.0, 90.0, 140.0])


def pelvis_scene() -> tuple[Volume, NDArray[np.uint8]]:
    """CT in HU (cortex of 1000 HU, 2.5 mm thick, around spongy bone of 250 HU in muscle of 50 HU) and its true labels.

    Head and socket are 3 mm apart, sacrum and ilium 4 mm, the pubic bones 6 mm.
    """
    counts = np.round((_HIGH - _LOW) / SPACING_MM).astype(int)
    first = _LOW + SPACING_MM / 2
    x, y, z = np.meshgrid(*(first[k] + SPACING_MM * np.arange(counts[k]) for k in range(3)), indexing="ij")
    points = np.stack([x, y, z]).transpose(0, 3, 2, 1)
    depths = {"sacrum": _box(points, (-42, 30, 20), (42, 70, 110))}
    for side, sign in (("left", 1), ("right", -1)):
        own = points * np.array([sign, 1, 1])[:, None, None, None]
        from_head = np.linalg.norm(own - HEADS["left"][:, None, None, None], axis=0)
        neck = _rod(own, (85, 0, 0), (125, 0, -25), 14)
        shaft = _rod(own, (125, 0, -25), (125, 0, -200), 16)
        depths[f"femur_{side}"] = np.minimum(np.minimum(from_head - RADIUS_MM, neck), shaft)
        socket = np.maximum(from_head - RADIUS_MM - GAP_MM - 8, 0.8 * (own[0] - 85) - 0.6 * own[2] - 4)
        ilium = _box(own, (46, -15, 25), (95, 60, 120))
        pubis = _rod(own, (65, -20, -5), (10, -35, -15), 7)
        hip = np.minimum(np.minimum(socket, ilium), pubis)
        depths[f"hip_{side}"] = np.maximum(hip, RADIUS_MM + GAP_MM - from_head)
    hu, labels = np.full(x.T.shape, 50.0), np.zeros(x.T.shape, np.uint8)
    for bone, depth in depths.items():
        hu[depth < 0] = 1000
        hu[depth < -2.5] = 250
        labels[depth < 0] = 1 + HIP.bone_names.index(bone)
    hu[:, :5] = -1000
    hu += np.random.default_rng(0).normal(0, 15, hu.shape)
    affine = axis_aligned((SPACING_MM,) * 3, (first[0], first[1], first[2]))
    return Volume(torch.from_numpy(hu.astype(np.float32)), affine), labels


def _box(points: NDArray[np.float64], low: tuple[float, ...], high: tuple[float, ...]) -> NDArray[np.float64]:
    sides = [np.maximum(a - p, p - b) for p, a, b in zip(points, low, high, strict=True)]
    depth: NDArray[np.float64] = np.max(sides, axis=0)
    return depth


def _rod(
    points: NDArray[np.float64], start: tuple[float, ...], end: tuple[float, ...], radius: float
) -> NDArray[np.float64]:
    a = np.array(start)[:, None, None, None]
    along = np.array(end)[:, None, None, None] - a
    share = (((points - a) * along).sum(0) / (along**2).sum()).clip(0, 1)
    depth: NDArray[np.float64] = np.linalg.norm(points - a - share * along, axis=0) - radius
    return depth
