"""Devices of several solids: each keeps its volume, and none lies within another."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Solid, Volume, label_share, solid_volumes, voxelise_mesh

PER_HU = 2.6828e-5  # 1/mm
OUTER = trimesh.creation.box((20.3, 12.2, 30.1))
INNER = trimesh.creation.box((8.6, 6.4, 50.7))  # through it, and out at both ends


def amount(volume: Volume, hu: float) -> float:
    """The volume in mm³ that a material of so many HU fills."""
    return float(volume.data.double().sum() * np.prod(volume.spacing_mm) / ((hu + 1000) * PER_HU))


@pytest.mark.parametrize("inner_last", [True, False])
def test_the_later_of_two_overlapping_boxes_replaces_the_earlier(inner_last: bool) -> None:
    solids = [Solid(OUTER, 900, "handle"), Solid(INNER, 9000, "sleeve")]
    shared = 8.6 * 6.4 * 30.1
    first, second = solids if inner_last else solids[::-1]
    under, over = solid_volumes([first, second], 0.5)
    assert under.lps_from_index.tolist() == over.lps_from_index.tolist()
    assert amount(over, second.hu) == pytest.approx(second.shape.volume, rel=0.01)
    assert amount(under, first.hu) == pytest.approx(first.shape.volume - shared, rel=0.01)
    share = under.data / ((first.hu + 1000) * PER_HU) + over.data / ((second.hu + 1000) * PER_HU)
    assert share.max() == pytest.approx(1, abs=1e-6)


def test_a_voxel_between_two_boxes_is_shared() -> None:
    left = trimesh.creation.box(bounds=[[-10, -5, -5], [0.2, 5, 5]])
    right = trimesh.creation.box(bounds=[[0.2, -5, -5], [10, 5, 5]])
    parts = solid_volumes([Solid(left, 0, "left"), Solid(right, 0, "right")], 0.5)
    assert [amount(part, 0) for part in parts] == pytest.approx([1020, 980], rel=0.01)
    total = torch.stack([part.data for part in parts]).sum(0)
    assert torch.allclose(total, voxelise_mesh(trimesh.creation.box((20, 10, 10)), 0.5, 0).data, atol=1e-6)


def test_one_solid_is_what_the_mesh_is() -> None:
    (alone,) = solid_volumes([Solid(OUTER, 5000, "device")], 0.5)
    assert torch.equal(alone.data, voxelise_mesh(OUTER, 0.5, 5000).data)


@pytest.mark.parametrize("spacing", [0.3, 0.5, 0.8])
def test_labels_beside_a_mesh_keep_volume_and_place(tmp_path: Path, spacing: float) -> None:
    """On a grid that is turned about z against the device's axes."""
    count = round(12 / spacing)
    labels = np.zeros((count + 8,) * 3, np.uint8)
    labels[4:-4, 4:-4, 4:-4] = 2
    image = sitk.GetImageFromArray(labels)
    image.SetSpacing((spacing,) * 3)
    turn = trimesh.transformations.rotation_matrix(0.3, [0, 0, 1])[:3, :3]
    image.SetDirection(turn.ravel().tolist())
    middle = np.array([40.0, 3.0, -2.0])
    image.SetOrigin((middle - turn @ np.full(3, (count + 7) * spacing / 2)).tolist())
    sitk.WriteImage(image, str(tmp_path / "labels.nrrd"))
    knob = label_share(tmp_path / "labels.nrrd", [2], 0.5)
    box, labelled = solid_volumes([Solid(OUTER, 900, "handle"), Solid(knob, 4000, "knob")], 0.5)
    assert amount(box, 900) == pytest.approx(OUTER.volume, rel=0.01)
    assert amount(labelled, 4000) == pytest.approx((count * spacing) ** 3, rel=0.01)
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in labelled.data.shape), indexing="ij")
    weight = labelled.data / labelled.data.sum()
    index = torch.stack([(weight * axis).sum() for axis in (x, y, z)])
    found = labelled.lps_from_index[:3, :3] @ index + labelled.lps_from_index[:3, 3]
    assert found.tolist() == pytest.approx(middle.tolist(), abs=0.05)


def test_a_solid_within_later_ones_is_named() -> None:
    inside = trimesh.creation.box((4, 4, 6))
    with pytest.raises(InputError, match=r"pin\.stl: later parts fill all of its space and replace it\. Name it after"):
        solid_volumes([Solid(inside, 9000, "pin.stl"), Solid(OUTER, 900, "handle.stl")], 0.5)
    solid_volumes([Solid(OUTER, 900, "handle.stl"), Solid(inside, 9000, "pin.stl")], 0.5)


def test_a_part_that_is_given_twice_is_named() -> None:
    """Half-filled voxels of its rim would be left of the first one."""
    thin = trimesh.creation.box((1.3, 1.3, 9.1))
    with pytest.raises(InputError, match=r"pin\.stl: a later part has the same shape at the same place"):
        solid_volumes([Solid(thin, 9000, "pin.stl"), Solid(thin.copy(), 900, "again.stl")], 0.5)


def test_parts_in_metres_are_refused() -> None:
    small = [Solid(mesh.copy().apply_scale(0.001), 900, "handle.stl") for mesh in (OUTER, INNER)]
    with pytest.raises(InputError, match=r"handle\.stl: its longest edge is 0\.0507 mm"):
        solid_volumes(small, 0.5)
