"""A device as voxels is the device as a mesh: drawn alike, in the same place, whatever the file's index order."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, exp_se3
from femoreg_torch.volume import Volume, labelled_device, scanned_device, voxelise_mesh

HU = 5000.0
CAMERA = centred_camera(1020.0, (1.0, 1.0), (240, 240))


def mesh() -> trimesh.Trimesh:
    """A sleeve along z with a block on one side, mm."""
    sleeve = trimesh.creation.annulus(4, 7, 80, sections=128)
    sleeve.apply_translation([0.0, 0.0, 40.0])
    block = trimesh.creation.box((20, 12, 15))
    block.apply_translation([14.5, 3.0, 20.0])
    return trimesh.util.concatenate([sleeve, block])


def inside(points: np.ndarray) -> np.ndarray:
    """Which points (..., 3) lie in the solid, by its closed form."""
    x, y, z = np.moveaxis(points, -1, 0)
    radius = np.hypot(x, y)
    sleeve = (radius > 4) & (radius < 7) & (z > 0) & (z < 80)
    return sleeve | ((abs(x - 14.5) < 10) & (abs(y - 3) < 6) & (abs(z - 20) < 7.5))


def write_voxels(path: Path, spacing: float, filled: float, empty: float, kind: type = np.int16) -> None:
    """The solid as voxels whose first two index axes run against the axes of its space, as most NIfTI files have it."""
    image = sitk.Image(*(int(n / spacing) for n in (38, 26, 86)), sitk.sitkFloat32)
    image.SetSpacing((spacing,) * 3)
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    image.SetOrigin((28.1, 15.2, -2.9))
    axes = [np.arange(n) * spacing for n in image.GetSize()]
    x, y, z = 28.1 - axes[0], 15.2 - axes[1], -2.9 + axes[2]
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1)
    filled_image = sitk.GetImageFromArray(np.where(inside(points), filled, empty).astype(kind))
    filled_image.CopyInformation(image)
    sitk.WriteImage(filled_image, str(path))


def drawn(volume: Volume) -> torch.Tensor:
    pose = exp_se3(torch.tensor([0.4, 0.7, -0.3, 0, 0, 0], dtype=torch.float64))
    pose[:3, 3] = torch.tensor([5, -8, 700])
    return project([volume], pose[None, None], CAMERA, 0.25)[0]


@pytest.mark.parametrize(
    ("spacing", "suffix", "limit"), [(0.3, "mha", 0.04), (0.5, "nii.gz", 0.04), (0.7, "nrrd", 0.06)]
)
def test_a_labelled_volume_is_drawn_as_the_mesh(tmp_path: Path, spacing: float, suffix: str, limit: float) -> None:
    """Hard labels know a wall of 3 mm to some half a voxel, so that coarse ones draw it less well."""
    write_voxels(tmp_path / f"device.{suffix}", spacing, 3, 1)
    expected = drawn(voxelise_mesh(mesh(), 0.25, HU))
    found = drawn(labelled_device(tmp_path / f"device.{suffix}", [3], HU, 0.5))
    assert (found - expected).abs().sum() < limit * expected.sum()
    assert found.sum() == pytest.approx(float(expected.sum()), rel=0.02)


def test_a_scan_in_hu_is_drawn_as_the_mesh(tmp_path: Path) -> None:
    write_voxels(tmp_path / "device.nii.gz", 0.5, HU, -1000)
    expected = drawn(voxelise_mesh(mesh(), 0.25, HU))
    found = drawn(scanned_device(tmp_path / "device.nii.gz"))
    assert (found - expected).abs().sum() < 0.04 * expected.sum()


def test_a_device_that_fills_its_file_fades_out_within_the_grid(tmp_path: Path) -> None:
    image = sitk.GetImageFromArray(np.ones((6, 5, 4), np.uint8))
    sitk.WriteImage(image, str(tmp_path / "device.nrrd"))
    volume = labelled_device(tmp_path / "device.nrrd", [1], HU, 0.5)
    share = volume.data / (6000 * 2.6828e-5)
    assert share.sum() == pytest.approx(120, rel=1e-6)
    assert volume.centre().tolist() == pytest.approx([1.5, 2, 2.5])
    for axis in range(3):
        assert not share.select(axis, 0).any()
        assert not share.select(axis, -1).any()


def test_bad_labels_are_told(tmp_path: Path) -> None:
    write_voxels(tmp_path / "device.nrrd", 1.0, 3, 0)
    with pytest.raises(InputError, match=r"device\.nrrd: no voxel carries label 2; labels there: \[3\]"):
        labelled_device(tmp_path / "device.nrrd", [3, 2], HU, 0.5)
    write_voxels(tmp_path / "share.nrrd", 1.0, 0.5, 0, np.float32)
    with pytest.raises(InputError, match=r"share\.nrrd: whole numbers"):
        labelled_device(tmp_path / "share.nrrd", [1], HU, 0.5)
    with pytest.raises(InputError, match="no such file"):
        labelled_device(tmp_path / "none.nrrd", [1], HU, 0.5)


def test_what_is_no_scan_in_air_is_told(tmp_path: Path) -> None:
    write_voxels(tmp_path / "labels.nrrd", 1.0, 3, 0)
    with pytest.raises(InputError, match="most of its outer faces are above"):
        scanned_device(tmp_path / "labels.nrrd")
    write_voxels(tmp_path / "air.nrrd", 1.0, -1000, -1000)
    with pytest.raises(InputError, match="no voxel is above"):
        scanned_device(tmp_path / "air.nrrd")
