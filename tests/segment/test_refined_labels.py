"""Labels on the CT's own voxels against solids whose shape is known."""

import re

import numpy as np
import pytest
import torch
from hip_scenes import FEMUR_LEFT, HIP_LEFT, answering, dice, hip_scene, shares_of
from scipy import ndimage

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.segment import segment_bones
from femoreg_torch.segment.refine import contact, refined_labels, unrefined_labels
from femoreg_torch.volume import Volume, resample_isotropic


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 0.8, 2.5), (3.0, 3.0, 3.0)])
def test_edges_are_those_of_the_ct(spacing: tuple[float, float, float]) -> None:
    ct, truth = hip_scene(spacing)
    shares, grid = shares_of(truth, spacing), resample_isotropic(ct, 3.0)
    found, coarse = refined_labels(ct, shares, grid, HIP), unrefined_labels(ct, shares, grid, HIP)
    for bone in (HIP_LEFT, FEMUR_LEFT):
        assert dice(found, truth, bone) > 0.95
        right_already = min(spacing) == 3.0  # this network, on its own voxels
        assert dice(found, truth, bone) > dice(coarse, truth, bone) - (0.04 if right_already else 0)


def test_what_the_network_cuts_off_or_adds_is_judged_by_the_cortex() -> None:
    spacing = (1.0, 1.0, 1.0)
    ct, truth = hip_scene(spacing)
    y, x = np.mgrid[: truth.shape[1], : truth.shape[2]]
    told = np.where((np.abs(y - 55) < 6) & (x < 62) & (truth == FEMUR_LEFT), 0, truth)
    beside = ndimage.binary_dilation(truth == FEMUR_LEFT, iterations=4) & (x > 60)
    told[beside & (truth == 0) & ~ndimage.binary_dilation(truth == HIP_LEFT, iterations=3)] = FEMUR_LEFT
    shares = 0.7 * shares_of(told, spacing) + 0.3 * shares_of(truth, spacing)
    found = refined_labels(ct, shares, resample_isotropic(ct, 3.0), HIP)
    assert dice(torch.from_numpy(told), truth, FEMUR_LEFT) < 0.8
    assert dice(found, truth, FEMUR_LEFT) > 0.97  # 0.85 by brightness and the network's share alone


def test_holes_are_closed_and_the_joint_is_open() -> None:
    ct, truth = hip_scene((1.0, 1.0, 1.0))
    found = refined_labels(ct, shares_of(truth, (1.0, 1.0, 1.0)), resample_isotropic(ct, 3.0), HIP).numpy()
    inside = ndimage.binary_erosion(truth == FEMUR_LEFT, iterations=3)
    assert (found[inside] == FEMUR_LEFT).mean() > 0.995
    assert not contact(found, HIP_LEFT, FEMUR_LEFT).any()


def test_metal_in_a_bone_stays_bone() -> None:
    ct, truth = hip_scene((1.5, 1.5, 1.5), metal=True)
    found = refined_labels(ct, shares_of(truth, (1.5, 1.5, 1.5)), resample_isotropic(ct, 3.0), HIP)
    assert dice(found, truth, FEMUR_LEFT) > 0.95


def test_a_whole_reading_says_sides_volumes_and_what_is_amiss() -> None:
    ct, truth = hip_scene((1.5, 1.5, 1.5), metal=True)
    found = segment_bones(ct, answering(shares_of(truth, (1.5, 1.5, 1.5))))
    assert set(found.volume_ml) == {"hip_left", "femur_left"}
    assert found.volume_ml["femur_left"] == pytest.approx((truth == FEMUR_LEFT).sum() * 1.5**3 / 1000, rel=0.05)
    told = " ".join(found.warnings)
    assert "right hip bone is not in the CT" in told
    assert "ml of metal" in told
    assert "no joint space is to be seen" not in told


def test_bones_that_touch_are_told() -> None:
    ct, truth = hip_scene((1.5, 1.5, 1.5))
    bright = ct.with_data(torch.where(ct.data > -500, torch.tensor(900.0), ct.data))
    grown = truth.copy()
    near = ndimage.binary_dilation(truth == FEMUR_LEFT, iterations=3) & (truth == 0)
    grown[near] = FEMUR_LEFT
    found = segment_bones(bright, answering(shares_of(grown, (1.5, 1.5, 1.5))))
    assert not contact(found.labels.data.numpy(), HIP_LEFT, FEMUR_LEFT).any()
    assert any("no joint space is to be seen" in told for told in found.warnings)


def test_a_ct_without_bone_or_without_a_hip_is_refused_in_one_line() -> None:
    ct, truth = hip_scene((3.0, 3.0, 3.0))
    soft = ct.with_data(ct.data.clamp(max=100))
    with pytest.raises(InputError, match="holds no bone"):
        segment_bones(soft, answering(shares_of(truth, (3.0, 3.0, 3.0))))
    nothing = shares_of(np.zeros_like(truth), (3.0, 3.0, 3.0))
    with pytest.raises(InputError, match="no hip bone and upper femur was found"):
        segment_bones(ct, answering(nothing))


def test_what_is_mostly_of_one_side_is_wholly_of_it() -> None:
    ct, truth = hip_scene((3.0, 3.0, 3.0))
    mixed = truth.copy()
    wrong = 1 + HIP.bone_names.index("femur_right")
    mixed[:5][mixed[:5] == FEMUR_LEFT] = wrong
    found = segment_bones(Volume(ct.data, ct.lps_from_index), answering(shares_of(mixed, (3.0, 3.0, 3.0))))
    assert "femur_right" not in found.volume_ml


def test_a_bone_of_air_is_left_out() -> None:
    """As where a scan ends in a slanted plane, and the network goes on with the spine."""
    ct, truth = hip_scene((3.0, 3.0, 3.0))
    spine = slice(40, 52), slice(2, 14), slice(4, 16)
    ct.data[spine], truth[spine] = -1000.0, 1 + HIP.bone_names.index("vertebrae")
    found = segment_bones(ct, answering(shares_of(truth, (3.0, 3.0, 3.0))), refine=False)
    assert set(found.volume_ml) == set(found.confidence) == {"hip_left", "femur_left"}
    assert not (found.labels.data == 1 + HIP.bone_names.index("vertebrae")).any()
    (told,) = (warning for warning in found.warnings if "vertebrae" in warning)
    assert re.fullmatch(r"what may be vertebrae \(\d+ ml, mean -\d+ HU\) was left out: no bone is as thin as air", told)
