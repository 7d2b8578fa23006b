"""CTs made worse on purpose keep their place in the patient."""

import numpy as np
import pytest
import torch

from femoreg_torch.geometry import transform_points
from femoreg_torch.volume import axis_aligned, label_box_centre, read_ct, read_labels, write_volume
from femoreg_torch.volume.grid import Volume
from sim.study.imperfect_ct import ImperfectCt, grown, spoil_ct, thick_slices


def ball(spacing: float = 1.0) -> tuple[Volume, Volume]:
    """A ball of 12 mm around (5, −3, 7), 800 HU, in a cube of 48 mm of fat, and its label map."""
    affine = axis_aligned((spacing,) * 3, (-19.0, -27.0, -17.0))
    z, y, x = torch.meshgrid(*[torch.arange(48, dtype=torch.float64)] * 3, indexing="ij")
    places = transform_points(affine, torch.stack([x, y, z], -1).reshape(-1, 3)).reshape(48, 48, 48, 3)
    inside = (places - torch.tensor([5.0, -3.0, 7.0])).norm(dim=-1) < 12
    return Volume(900.0 * inside.float() - 100.0, affine), Volume(5 * inside.to(torch.uint8), affine)


def centroid(ct: Volume) -> torch.Tensor:
    """The middle of mass of what is above 0 HU, LPS mm."""
    weight = ct.data.double().clamp(min=0)
    index = torch.stack([g.double() for g in torch.meshgrid(*map(torch.arange, weight.shape), indexing="ij")], -1)
    middle = (index * weight[..., None]).sum((0, 1, 2)) / weight.sum()
    return transform_points(ct.lps_from_index, middle.flip(0)[None])[0]


@pytest.mark.parametrize(
    "change", [ImperfectCt(slice_mm=3.0), ImperfectCt(blur_mm=1.0), ImperfectCt(hu_scale=1.05), ImperfectCt()]
)
def test_what_is_in_a_spoilt_ct_stays_where_it_is(tmp_path, change):
    ct, labels = ball()
    write_volume(tmp_path / "ct.nii.gz", ct)
    write_volume(tmp_path / "labels.nii.gz", labels)
    spoil_ct(tmp_path, torch.zeros(3), change)
    found = read_ct(tmp_path / "ct.nii.gz")
    torch.testing.assert_close(centroid(found), centroid(ct), atol=0.05, rtol=0)
    assert float(found.data.max()) == pytest.approx(840.0 if change.hu_scale > 1 else 800.0, abs=1)
    middle = label_box_centre(read_labels(tmp_path / "labels.nii.gz", found), (5,))
    torch.testing.assert_close(middle, torch.tensor([5.0, -3.0, 7.0], dtype=torch.float64), atol=1.6, rtol=0)


def test_thick_slices_hold_the_means_of_thin_ones():
    thick = thick_slices(ball()[0], 3.0, mean=True)
    assert thick.data.shape == (16, 48, 48)
    assert thick.spacing_mm[2] == pytest.approx(3.0)
    assert float(thick.data.double().sum()) * 3 == pytest.approx(float(ball()[0].data.double().sum()))


def test_a_scan_that_ends_below_the_head_is_cut_there_and_moved_nowhere(tmp_path):
    ct, labels = ball()
    write_volume(tmp_path / "ct.nii.gz", ct)
    write_volume(tmp_path / "labels.nii.gz", labels)
    spoil_ct(tmp_path, torch.tensor([5.0, -3.0, 7.0]), ImperfectCt(cut_mm=6.0))
    found = read_ct(tmp_path / "ct.nii.gz")
    assert len(found.data) == 48 - 18  # −17 mm to 1 mm
    np.testing.assert_array_equal(found.data, ct.data[18:])
    assert float(found.lps_from_index[2, 3]) == pytest.approx(1.0)


def test_labels_grow_into_nothing_else_and_shrink_by_as_much():
    two = np.zeros((9, 9, 9), np.uint8)
    two[3:6, 3:6, 3:6], two[3:6, 3:6, 6:8] = 1, 2
    more = grown(two, 1)
    assert (more[two > 0] == two[two > 0]).all()
    assert (more == 1).sum() == 27 + 5 * 9
    assert (grown(two, -1) == 1).sum() == 1  # faces to the other label are given up as well
