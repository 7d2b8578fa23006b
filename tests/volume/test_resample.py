"""Crops and resampled volumes against a field that is known everywhere in space."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, axis_aligned, crop, halved, resample_isotropic, sharpened

GRADIENT = torch.tensor([1.5, -0.7, 0.4], dtype=torch.float64)  # HU per mm of L, P, S


def positions(volume: Volume) -> Tensor:
    """LPS (Z, Y, X, 3) of all voxel centres."""
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in volume.data.shape), indexing="ij")
    return torch.stack([x, y, z], -1) @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]


def ramp() -> Volume:
    """A field that is linear in LPS on an oblique grid of unequal spacing."""
    affine = axis_aligned((0.7, 0.5, 1.6), (-20.0, 10.0, 300.0))
    turn = Rotation.from_euler("xyz", [10, 20, -5], degrees=True).as_matrix()
    affine[:3, :3] = torch.from_numpy(turn) @ affine[:3, :3]
    empty = Volume(torch.zeros(20, 31, 24), affine)
    return empty.with_data((positions(empty) @ GRADIENT).float())


def test_crop_keeps_values_at_their_places() -> None:
    part = crop(ramp(), (3, -5, 2), (9, 11, 99))
    assert tuple(part.data.shape) == (18, 11, 6)
    torch.testing.assert_close(part.data, (positions(part) @ GRADIENT).float())


def test_an_empty_crop_is_refused() -> None:
    with pytest.raises(InputError, match="no voxel"):
        crop(ramp(), (30, 0, 0), (40, 5, 5))


@pytest.mark.parametrize("spacing_mm", [0.5, 1.0, 1.37, 2.5])
def test_resampling_keeps_a_linear_field_in_place(spacing_mm: float) -> None:
    volume = resample_isotropic(ramp(), spacing_mm)
    assert volume.spacing_mm == pytest.approx((spacing_mm,) * 3)
    inside = tuple(slice(n // 4, n - n // 4) for n in volume.data.shape)  # values at the faces are repeated outwards
    expected = (positions(volume) @ GRADIENT).float()
    tolerance_mm = 0.03 * spacing_mm  # the filter is a triangle in samples, whose mean is not quite its centre
    torch.testing.assert_close(volume.data[inside], expected[inside], atol=1.7 * tolerance_mm, rtol=0)


def test_resampling_keeps_the_outer_face_of_the_first_voxel() -> None:
    old, new = ramp(), resample_isotropic(ramp(), 1.0)
    corner = torch.tensor([-0.5, -0.5, -0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(new.lps_from_index @ corner, old.lps_from_index @ corner)


def test_coarser_voxels_are_averages_and_not_samples() -> None:
    board = (torch.arange(40)[:, None, None] + torch.arange(40)[:, None] + torch.arange(40)) % 2 * 1000.0
    coarse = resample_isotropic(Volume(board, axis_aligned((0.5, 0.5, 0.5), (0.0, 0.0, 0.0))), 1.0)
    torch.testing.assert_close(coarse.data[2:-2, 2:-2, 2:-2], torch.full((16, 16, 16), 500.0))


@pytest.mark.parametrize(("dtype", "label"), [(torch.uint8, 5), (torch.int32, 65535)])
@pytest.mark.parametrize("spacing_mm", [0.43, 1.37])  # where no new voxel lies between two
def test_labels_stay_labels_each_that_of_the_nearest_voxel(dtype: torch.dtype, label: int, spacing_mm: float) -> None:
    random = torch.rand(10, 10, 10, generator=torch.Generator().manual_seed(0))
    labels = Volume((random > 0.5).to(dtype) * label, ramp().lps_from_index)
    new = resample_isotropic(labels, spacing_mm, nearest=True)
    assert new.data.dtype == dtype
    homogeneous = torch.cat([positions(new), torch.ones(*new.data.shape, 1)], -1).double()
    x, y, z = (homogeneous @ torch.linalg.inv(labels.lps_from_index).T)[..., :3].round().long().clamp(0, 9).unbind(-1)
    assert torch.equal(new.data, labels.data[z, y, x])


def test_halved_volumes_keep_sums_and_places() -> None:
    generator = torch.Generator().manual_seed(0)
    volume = Volume(torch.rand(7, 10, 9, generator=generator), axis_aligned((1.0, 1.5, 2.0), (3.0, -4.0, 5.0)))
    half = halved(volume)
    assert half.data.shape == (4, 5, 5)
    assert half.spacing_mm == pytest.approx((2.0, 3.0, 4.0))
    torch.testing.assert_close(8 * half.data.sum(), volume.data.sum())
    torch.testing.assert_close(half.data[1, 2, 3], volume.data[2:4, 4:6, 6:8].mean())
    middle = half.lps_from_index @ torch.tensor([3.0, 2.0, 1.0, 1.0], dtype=torch.float64)
    eight = volume.lps_from_index @ torch.tensor([6.5, 4.5, 2.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(middle, eight)


def test_voxels_larger_than_the_volume_are_refused() -> None:
    with pytest.raises(InputError, match="larger than the whole volume"):
        resample_isotropic(ramp(), 40.0)


def test_what_is_sharpened_is_no_wider_than_what_its_voxels_are_means_of() -> None:
    """Second moments of slabs at all places of a grid, and of what interpolation makes of their means over voxels."""
    places = np.arange(-10, 10.0001, 0.01)
    edges = np.arange(-8, 9) - 0.5  # of voxels

    def spread(values: np.ndarray) -> float:
        middle = np.average(places, weights=values)
        return float(np.average((places - middle) ** 2, weights=values))

    for axis in range(3):
        wider, blurred = [], []
        for low in np.linspace(-3.2, -2.2, 20, endpoint=False):
            high = low + 5.7
            means = np.clip(edges[1:], low, high) - np.clip(edges[:-1], low, high)
            row = torch.zeros(16, 5, 5)
            row[:, 2, 2] = torch.from_numpy(means)
            volume = Volume(row.movedim(0, axis).contiguous(), axis_aligned((1, 1, 1), (0, 0, 0)))
            sharp = sharpened(volume).data.movedim(axis, 0).sum((1, 2)).double().numpy()
            assert sharp.sum() == pytest.approx(5.7)
            wider.append(spread(np.interp(places, np.arange(-8, 8), sharp)) - 5.7**2 / 12)
            blurred.append(spread(np.interp(places, np.arange(-8, 8), means)) - 5.7**2 / 12)
        assert np.mean(wider) == pytest.approx(0, abs=0.003)
        assert np.mean(blurred) == pytest.approx(0.25, abs=0.003)


def test_sharpened_solids_stay_flat_inside_and_empty_far_away() -> None:
    data = torch.zeros(12, 14, 10)
    data[3:9, 3:11, 3:7] = 0.3
    volume = Volume(data, axis_aligned((0.5, 0.5, 0.5), (0, 0, 0)))
    sharp = sharpened(volume)
    assert torch.equal(sharp.lps_from_index, volume.lps_from_index)
    torch.testing.assert_close(sharp.data[4:8, 4:10, 4:6], data[4:8, 4:10, 4:6])
    far = torch.ones_like(data, dtype=torch.bool)
    far[2:10, 2:12, 2:8] = False
    assert (sharp.data[far] == 0).all()
    assert sharp.data.sum() == pytest.approx(float(data.sum()), rel=1e-5)
    assert sharp.data[2, 5, 5] == pytest.approx(-0.3 / 8)
    assert torch.equal(volume.data, data)  # it is not changed in place
