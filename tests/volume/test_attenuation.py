"""Attenuation of water, and which voxels of a bone are rendered."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial.transform import Rotation

from femoreg_torch.errors import InputError
from femoreg_torch.volume import (
    Volume,
    axis_aligned,
    hu_to_attenuation,
    label_box_centre,
    looked_up,
    structure_attenuation,
)
from femoreg_torch.volume.attenuation import _dilated

BONE, OTHER = 5, 1


def test_water_and_air() -> None:
    mu = hu_to_attenuation(torch.tensor([-1000.0, 0, 1000]), -1000)
    assert mu.tolist() == pytest.approx([0, 0.02683, 0.05366], abs=1e-5)
    assert hu_to_attenuation(torch.tensor(40.0), 50) == 0


def hip() -> tuple[Volume, Volume]:
    """A ball of bone (radius 8 voxels, soft rim of 3) beside a block of another bone, on an oblique grid."""
    affine = axis_aligned((1.0, 1.2, 0.8), (-100.0, 50.0, 20.0))
    affine[:3, :3] = torch.from_numpy(Rotation.from_euler("zx", [25, 10], degrees=True).as_matrix()) @ affine[:3, :3]
    z, y, x = torch.meshgrid(torch.arange(40), torch.arange(44), torch.arange(50), indexing="ij")
    radius = ((x - 20.0) ** 2 + (y - 22.0) ** 2 + (z - 18.0) ** 2).sqrt()
    other = x >= 29
    hu = torch.where(other, 900.0, 1000 * ((11 - radius) / 3).clamp(0, 1))
    labels = torch.zeros(40, 44, 50, dtype=torch.uint8)
    labels[radius <= 8] = BONE
    labels[other] = OTHER
    return Volume(hu, affine), Volume(labels, affine)


def test_the_rim_is_kept_but_no_other_bone() -> None:
    ct, labels = hip()
    bare, grown = structure_attenuation(ct, labels, [BONE], 0), structure_attenuation(ct, labels, [BONE], 2)
    assert grown.data.max() == pytest.approx((1000 - 50) * 2.6828e-5, rel=1e-5)
    first = torch.linalg.solve(ct.lps_from_index, grown.lps_from_index[:, 3])[:3]
    torch.testing.assert_close(first, first.round(), atol=1e-10, rtol=0)  # the crop lies on the voxels of the CT
    x0, y0, z0 = first.round().long().tolist()
    assert (x0, y0, z0) == (20 - 10 - 2, 22 - 10 - 2, 18 - 10 - 2)  # 8 and 2 grown, 2 of margin
    assert grown.data[18 - z0, 22 - y0, 10 - x0] == pytest.approx((1000 / 3 - 50) * 2.6828e-5, rel=1e-4)  # radius 10
    assert grown.data[18 - z0, 22 - y0, 28 - x0] > 0  # radius 8, next to the other bone
    assert (grown.data[:, :, 29 - x0 :] == 0).all()
    assert (bare.data > 0).sum() == (labels.data == BONE).sum()


def test_a_mask_grows_as_scipy_grows_it() -> None:
    random = np.random.default_rng(0)
    mask, allowed = random.random((9, 12, 7)) < 0.05, random.random((9, 12, 7)) < 0.6
    allowed |= mask
    for times in (1, 2, 3):
        expected = ndimage.binary_dilation(mask, iterations=times, mask=allowed)
        np.testing.assert_array_equal(_dilated(mask, allowed, times), expected)


@pytest.mark.parametrize(("kind", "entries"), [(np.uint8, 5), (np.uint8, 400), (np.int32, 400)])
def test_labels_are_looked_up_in_a_table_of_any_length(kind: type, entries: int) -> None:
    labels = np.random.default_rng(0).integers(0, min(entries, 256), (3, 4, 5)).astype(kind)
    for table in (np.arange(entries, dtype=np.float32) / 2, (np.arange(entries) % 7).astype(np.uint8)):
        np.testing.assert_array_equal(looked_up(table, labels), table[labels])
        np.testing.assert_array_equal(looked_up(table, labels[:, ::2]), table[labels[:, ::2]])


def test_the_crop_keeps_its_place_in_space() -> None:
    ct, labels = hip()
    volume = structure_attenuation(ct, labels, [BONE], 0)
    weights = volume.data.double()
    z, y, x = (torch.arange(n, dtype=torch.float64) for n in weights.shape)
    sums = [weights.sum((0, 1)) @ x, weights.sum((0, 2)) @ y, weights.sum((1, 2)) @ z, weights.sum()]
    centroid = volume.lps_from_index @ (torch.stack(sums) / weights.sum())
    centre = ct.lps_from_index @ torch.tensor([20.0, 22, 18, 1], dtype=torch.float64)
    torch.testing.assert_close(centroid, centre, atol=1e-6, rtol=0)


def test_a_label_that_is_not_there_and_a_label_of_air() -> None:
    ct, labels = hip()
    with pytest.raises(InputError, match=r"labels \[7\]"):
        structure_attenuation(ct, labels, [7])
    with pytest.raises(InputError, match="above 50 HU"):
        structure_attenuation(ct.with_data(ct.data * 0 - 1000), labels, [BONE])


def test_the_middle_of_a_structure_is_that_of_its_box() -> None:
    _, labels = hip()
    middle = labels.lps_from_index @ torch.tensor([20.0, 22, 18, 1], dtype=torch.float64)
    torch.testing.assert_close(label_box_centre(labels, [BONE, 9]), middle[:3])
    with pytest.raises(InputError, match=r"labels \[7, 200\]"):
        label_box_centre(labels, [7, 200])
