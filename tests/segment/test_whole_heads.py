"""Heads of fatty marrow, of which a network saw the dense middle alone, against the solid that they are."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.anatomy import HIP
from femoreg_torch.segment.whole_heads import whole_heads

_FEMUR, _HIP = (1 + HIP.bone_names.index(name) for name in ("femur_left", "hip_left"))
_CENTRE, _RADIUS = np.array([62.0, 55.0, 58.0]), 24.0  # z, y, x in mm


def fatty_hip(
    spacing: tuple[float, float, float], flat: float = 1.0, head_hu: float = 0.0
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """HU, labels of a network, and true labels (Z, Y, X) of a head in its socket; `spacing` along x, y, z in mm.

    The marrow around the dense middle has `head_hu`. With `flat` the head is so many times as wide as high.
    """
    step = np.array(spacing[::-1])
    shape = tuple(np.ceil(np.array([110.0, 110.0, 120.0]) / step).astype(int))
    z, y, x = (axis * s - c for axis, s, c in zip(np.ogrid[tuple(map(slice, shape))], step, _CENTRE, strict=True))
    apart = np.sqrt((z * flat) ** 2 + y**2 + x**2 / flat)
    neck = (x - z > 0) & (np.sqrt(y**2 + (x + z) ** 2 / 2) < 14) & (x - z < 75)
    truth = np.where((apart < _RADIUS) | neck, _FEMUR, 0).astype(np.uint8)
    roof = (apart > _RADIUS + 4) & (apart < _RADIUS + 9) & (z - x > -6)
    truth[roof & (truth == 0)] = _HIP
    cortex = (apart > _RADIUS - 1.5) & (apart < _RADIUS) & ~neck
    hu = np.where(truth == _FEMUR, head_hu, 40.0)
    hu[(apart < 13) | (neck & (apart > _RADIUS))] = 320
    hu[cortex], hu[truth == _HIP] = 420, 480
    smooth = ndimage.gaussian_filter(hu, 0.6 / step)
    noisy = smooth + 12 * np.random.default_rng(3).standard_normal(shape)
    told = np.where((truth == _FEMUR) & (apart < _RADIUS - 2) & (apart > 18) & ~neck, 0, truth).astype(np.uint8)
    told[cortex & (z - x > 0) & (apart > _RADIUS - 2)] = _HIP
    return noisy.astype(np.float32), told, truth


def dice(found: NDArray[np.uint8], truth: NDArray[np.uint8], label: int) -> float:
    one, other = found == label, truth == label
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 0.8, 3.0), (2.0, 2.0, 2.0)])
def test_a_head_whose_middle_alone_was_seen_is_filled_to_its_cortex(spacing: tuple[float, float, float]) -> None:
    hu, told, truth = fatty_hip(spacing)
    found = whole_heads(told, hu, np.array(spacing), HIP)
    assert dice(told, truth, _FEMUR) < 0.93
    assert dice(found, truth, _FEMUR) > 0.97
    assert dice(found, truth, _HIP) > max(0.93, dice(told, truth, _HIP))


def test_a_head_that_is_right_stays_as_it_is() -> None:
    hu, _, truth = fatty_hip((1.0, 1.0, 1.0))
    found = whole_heads(truth, hu, np.ones(3), HIP)
    assert dice(found, truth, _FEMUR) > 0.99
    assert dice(found, truth, _HIP) > 0.98


@pytest.mark.parametrize("flat", [1.1, 1.2])
def test_a_flattened_head_is_not_filled_far_beyond_its_cortex(flat: float) -> None:
    hu, told, truth = fatty_hip((1.0, 1.0, 1.0), flat)
    found = whole_heads(told, hu, np.ones(3), HIP)
    assert dice(found, truth, _FEMUR) > dice(told, truth, _FEMUR) + 0.05
    beyond = (found == _FEMUR) & (truth != _FEMUR)
    assert beyond.sum() < 0.05 * (truth == _FEMUR).sum()
    assert beyond[ndimage.distance_transform_edt(truth != _FEMUR) > 4].sum() == 0


def test_the_head_of_a_prosthesis_is_left_alone() -> None:
    hu, told, _ = fatty_hip((1.0, 1.0, 1.0), head_hu=2900.0)
    assert np.array_equal(whole_heads(told, hu, np.ones(3), HIP), told)


def test_bones_without_a_joint_are_left_alone() -> None:
    hu, told, _ = fatty_hip((2.0, 2.0, 2.0))
    alone = np.where(told == _HIP, 0, told)
    assert np.array_equal(whole_heads(alone, hu, np.full(3, 2.0), HIP), alone)
    nothing = np.full_like(hu, 40.0)
    assert np.array_equal(whole_heads(told, nothing, np.full(3, 2.0), HIP), told)
