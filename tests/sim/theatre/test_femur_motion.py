"""The turned femur: where its points go, and that everything else stays."""

import math

import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import exp_so3
from femoreg_torch.volume import Volume, axis_aligned
from sim.theatre.femur_motion import rotate_femur

HIP_ID, FEMUR_ID, OTHER_ID = 11, 15, 16  # any ids of a label map
HEAD = torch.tensor([10.0, -5.0, 20.0], dtype=torch.float64)
TIP = HEAD + torch.tensor([30.0, 10.0, -40.0], dtype=torch.float64)
TURN = exp_so3(torch.tensor([0.1, -0.12, 0.15], dtype=torch.float64))


@pytest.fixture(scope="module")
def hip():
    """A femur (head, neck down to a dense marker at TIP) and a plate of pelvis in soft tissue; 1.5 mm voxels."""
    affine = axis_aligned((1.5, 1.5, 1.5), (-70.0, -75.0, -80.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (110, 90, 100)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 1.5 + affine[:3, 3]
    along = ((points - HEAD) @ (TIP - HEAD) / (TIP - HEAD).norm() ** 2).clamp(0, 1)
    neck = (points - HEAD - along[..., None] * (TIP - HEAD)).norm(dim=-1) < 8
    marker = (points - TIP).norm(dim=-1) < 4
    femur = ((points - HEAD).norm(dim=-1) < 20) | neck | marker
    pelvis = (points[..., 0] < HEAD[0] - 23) & (points[..., 0] > HEAD[0] - 33) & ((points - HEAD).norm(dim=-1) < 40)
    hu = torch.full(points.shape[:3], 40.0)
    hu[femur | pelvis] = 400
    hu[marker] = 2000
    labels = torch.zeros_like(hu, dtype=torch.uint8)
    labels[pelvis], labels[femur] = HIP_ID, FEMUR_ID
    return Volume(hu, affine), Volume(labels, affine)


def centroid(volume, mask):
    index = mask.nonzero().flip(1).to(torch.float64)
    return (index @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]).mean(0)


def test_a_marker_in_the_femur_goes_where_the_rotation_takes_it(hip):
    ct, labels = hip
    moved = rotate_femur(ct, labels, (FEMUR_ID,), TURN, HEAD)
    expected = HEAD + TURN @ (centroid(ct, ct.data > 1200) - HEAD)
    assert (centroid(moved, moved.data > 1200) - expected).norm() < 0.3
    assert (expected - TIP).norm() > 5


def test_the_pelvis_keeps_every_voxel_and_far_tissue_too(hip):
    ct, labels = hip
    moved = rotate_femur(ct, labels, (FEMUR_ID,), TURN, HEAD)
    pelvis = labels.data == HIP_ID
    assert torch.equal(moved.data[pelvis], ct.data[pelvis])
    assert torch.equal(moved.data[:, :, :5], ct.data[:, :, :5])


def test_bone_is_neither_lost_nor_doubled(hip):
    ct, labels = hip
    moved = rotate_femur(ct, labels, (FEMUR_ID,), TURN, HEAD)
    before, after = ((v.data - 40).clamp_min(0).double().sum().item() for v in (ct, moved))
    assert after == pytest.approx(before, rel=0.02)
    assert moved.data.min() > 30
    assert moved.data.max() <= 2000


def test_no_turn_leaves_the_ct_as_it_is(hip):
    ct, labels = hip
    same = rotate_femur(ct, labels, (FEMUR_ID,), torch.eye(3, dtype=torch.float64), HEAD)
    assert (same.data - ct.data).abs().max() < 0.5


def test_bones_of_the_other_side_stay(hip):
    ct, labels = hip
    both = labels.with_data(labels.data.clone())
    both.data[:10][:, :10, :10] = OTHER_ID
    moved = rotate_femur(
        ct, both, (FEMUR_ID,), exp_so3(torch.tensor([0, 0, math.radians(15)], dtype=torch.float64)), HEAD
    )
    assert torch.equal(moved.data[:10, :10, :10], ct.data[:10, :10, :10])


def test_a_label_map_without_the_femur_is_refused(hip):
    ct, labels = hip
    with pytest.raises(InputError, match="femur"):
        rotate_femur(ct, labels, (OTHER_ID,), TURN, HEAD)
