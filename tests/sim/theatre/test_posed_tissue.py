"""A patient taken apart for imaging: the parts add up, bones move rigidly, and a few pixels tell all of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, exp_so3, rigid, transform_points
from femoreg_torch.volume import Volume, axis_aligned
from sim.physics.line_integrals import areal_densities, areal_tissue
from sim.physics.materials import WATER_PER_BONE, tissue_densities
from sim.physics.tissue_densities import separate
from sim.theatre.posed_tissue import areal_posed_tissue, take_apart

HIP_ID, FEMUR_ID, OTHER_ID = 11, 15, 16  # any ids of a label map
HEAD = torch.tensor([12.0, -5.0, 20.0], dtype=torch.float64)
TIP = HEAD + torch.tensor([30.0, 10.0, -40.0], dtype=torch.float64)
TURN = exp_so3(torch.tensor([0.1, -0.12, 0.15], dtype=torch.float64))
STILL = torch.eye(3, dtype=torch.float64)
AP = rigid(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64),
    torch.tensor([0.0, 0.0, 750.0], dtype=torch.float64),
)
CAMERA = centred_camera(1020.0, (0.388, 0.388), (512, 512))


def make_hip(noise_hu):
    """A femur with a dense marker at TIP, a plate of pelvis, all in muscle; CT in HU and labels at 0.75 mm."""
    affine = axis_aligned((0.75,) * 3, (-70.0, -60.0, -50.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in (140, 150, 190)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 0.75 + affine[:3, 3].float()
    head, tip = HEAD.float(), TIP.float()
    along = ((points - head) @ (tip - head) / (tip - head).norm() ** 2).clamp(0, 1)
    depth = torch.maximum(
        20 - (points - head).norm(dim=-1), 8 - (points - head - along[..., None] * (tip - head)).norm(dim=-1)
    )
    plate = torch.minimum(head[0] - 23 - points[..., 0], points[..., 0] - head[0] + 33)
    hu = 50 + 700 * ((depth / 0.75 + 0.5).clamp(0, 1) + (plate / 0.75 + 0.5).clamp(0, 1))
    hu += 700 * (3 - (points - tip).norm(dim=-1)).clamp(0, 1)
    labels = torch.zeros_like(hu, dtype=torch.uint8)
    labels[plate > 0], labels[depth > 0] = HIP_ID, FEMUR_ID
    hu += noise_hu * torch.randn(hu.shape, generator=torch.Generator().manual_seed(0))
    hu[:, :3], hu[:, -3:] = -1000, -1000
    return Volume(hu.round(), affine), Volume(labels, affine)


@pytest.fixture(scope="module")
def hip():
    return make_hip(15)


def test_parts_hold_the_mass_of_the_ct_and_all_its_bone(hip):
    ct, labels = hip
    filled, bone, (femur,), _ = separate(ct, labels, [(FEMUR_ID,)])
    soft, dense = tissue_densities(ct.data[:, :150, :190])
    voxel, block = 0.75**3, np.prod(filled.spacing_mm)
    bones = (bone.data.double().sum() + femur.data.double().sum()).item() * voxel
    mass = filled.data.double().sum().item() * block + (1 - WATER_PER_BONE) * bones
    assert mass == pytest.approx((soft + dense).double().sum().item() * voxel, rel=2e-3)
    within = dense[(labels.data > 0)].double().sum().item() * voxel
    assert within < bones < 1.05 * within  # the rim, but not the noise of the muscle
    assert filled.data[10:-10, 10:-10, 10:-10].std() < 0.02  # no edge of bone is left


def test_nothing_turned_the_shadow_is_that_of_the_ct():
    """Against line integrals of both densities of every voxel."""
    ct, labels = make_hip(0)
    found = areal_posed_tissue(take_apart(ct, labels, (FEMUR_ID,), STILL, HEAD), AP, CAMERA, 0.5)
    parts = dict(zip(("water", "bone"), tissue_densities(ct.data), strict=True))
    expected = areal_densities({name: ct.with_data(part) for name, part in parts.items()}, AP, CAMERA, 0.5)
    inner = (slice(180, 330), slice(160, 380))
    for name, image in expected.items():
        assert (found[name] - image)[inner].abs().max() < 0.02 * image[inner].max()


def test_few_pixels_tell_the_others(hip):
    """The picture interpolated from every third pixel is the one of all pixels, to a thousandth of its range."""
    ct, labels = hip
    filled, bone, (femur,), _ = separate(ct, labels, [(FEMUR_ID,)])
    fine = replace(CAMERA, pixel_mm=(0.15, 0.15), shape=(301, 298), principal_point_px=(40.0, 130.0))
    found = areal_tissue(filled, AP, [bone, femur], torch.stack([AP, AP]), fine, 0.5)["bone"]
    direct = areal_densities({"rest": bone, "femur": femur}, AP, fine, 0.5)
    expected = direct["rest"] + direct["femur"]
    difference = (found - expected).abs()
    assert expected.max() > 1
    assert difference.max() < 0.02 * expected.max()
    assert difference.square().mean().sqrt() < 2e-3 * expected.max()


def test_the_femur_is_found_where_the_turn_takes_it(hip):
    ct, labels = hip
    tissue = take_apart(ct, labels, (FEMUR_ID,), TURN, HEAD)
    dense = tissue.femur.data * (tissue.femur.data > 1.2)
    index = dense.nonzero().flip(1).to(torch.float64)
    weight = dense[dense > 0].double()
    centre = transform_points(
        tissue.femur.lps_from_index, (weight[:, None] * index).sum(0, keepdim=True) / weight.sum()
    )
    assert (centre - TIP).norm() < 0.3
    moved = transform_points(tissue.lps_from_femur, centre)
    assert (moved - (HEAD + TURN @ (TIP - HEAD))).norm() < 0.3
    assert (moved - TIP).norm() > 5
    assert tissue.bone.data.max() < 1.2  # the marker has left no ghost behind


def test_a_label_map_without_the_femur_is_refused(hip):
    with pytest.raises(InputError, match=str(OTHER_ID)):
        take_apart(*hip, (OTHER_ID,), TURN, HEAD)


def test_tissue_on_a_device_keeps_the_bones_that_are_held_apart(hip):
    tissue = take_apart(*hip, (FEMUR_ID,), STILL, HEAD, apart=[(HIP_ID,)])
    moved = tissue.to(torch.device("meta"))  # a device without memory
    assert len(moved.apart) == len(tissue.apart) == 1
    assert moved.apart[0].data.shape == tissue.apart[0].data.shape
    volumes = (moved.filled, moved.bone, moved.femur, *moved.apart)
    assert {volume.data.device.type for volume in volumes} == {"meta"}
    assert torch.equal(moved.lps_from_femur, tissue.lps_from_femur)
