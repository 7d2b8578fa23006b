"""Volumes from files against SimpleITK's own index-to-point transform, and every way in which a file can be wrong."""

import gzip
import struct
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from fuzz_faults import full_after
from scipy.spatial.transform import Rotation

from femoreg_torch.anatomy import label_table
from femoreg_torch.errors import InputError
from femoreg_torch.volume import (
    Volume,
    axis_aligned,
    check_inside,
    label_box_centre,
    read_ct,
    read_label_map,
    read_labels,
    read_labels_told,
    read_landmarks,
    read_volume,
    structure_attenuation,
    write_volume,
)

OBLIQUE = Rotation.from_euler("xyz", [12, -8, 20], degrees=True).as_matrix()
DIRECTIONS = {
    "LPS": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "RPI": np.diag([-1.0, 1.0, -1.0]),
    "sagittal": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "oblique": OBLIQUE,
    "oblique RAS": OBLIQUE @ np.diag([-1.0, -1.0, 1.0]),
    "left-handed": np.diag([1.0, -1.0, 1.0]),  # as dcm2niix and FSL store an axial CT
    "oblique left-handed": OBLIQUE @ np.diag([1.0, -1.0, 1.0]),
}
BRIGHT = (2, 5, 4)  # x, y, z index of the one bright voxel


def ct_image(direction: np.ndarray = DIRECTIONS["LPS"], dtype: type = np.int16) -> sitk.Image:
    """A CT of air (8 × 9 × 7 voxels) with one voxel of bone."""
    array = np.full((7, 9, 8), -1000, dtype)
    array[BRIGHT[::-1]] = 1200
    image = sitk.GetImageFromArray(array)
    image.SetSpacing((0.8, 0.9, 2.5))
    image.SetOrigin((-40.0, 13.0, 200.0))
    image.SetDirection(direction.ravel().tolist())
    return image


def brightest_point(volume: Volume) -> np.ndarray:
    z, y, x = np.unravel_index(int(volume.data.argmax()), volume.data.shape)
    return (volume.lps_from_index @ torch.tensor([x, y, z, 1.0], dtype=torch.float64))[:3].numpy()


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".nrrd"])
def test_every_index_order_ends_in_lps_with_its_points_in_place(
    tmp_path: Path, direction: np.ndarray, suffix: str
) -> None:
    image = ct_image(direction)
    sitk.WriteImage(image, str(tmp_path / f"ct{suffix}"))
    volume = read_ct(tmp_path / f"ct{suffix}")
    assert volume.data.dtype == torch.float32
    np.testing.assert_allclose(brightest_point(volume), image.TransformIndexToPhysicalPoint(BRIGHT), atol=1e-5)
    cosines = volume.lps_from_index[:3, :3] / torch.tensor(volume.spacing_mm)
    assert (cosines.diagonal() > 0.8).all()  # index axes run along +L, +P, +S


def big_endian(folder: Path, suffix: str, image: sitk.Image) -> Path:
    """The image as a raw file whose numbers have their high bytes first, header written by hand."""
    values = sitk.GetArrayFromImage(image).astype(">i2")
    path, origin = folder / f"ct{suffix}", image.GetOrigin()
    columns = np.reshape(image.GetDirection(), (3, 3)).T
    if suffix == ".nii":
        affine = np.eye(4)
        affine[:3, :3], affine[:3, 3] = (columns.T * image.GetSpacing()), origin
        header = nibabel.Nifti1Header(endianness=">")
        header.set_data_dtype(">i2")
        flip = np.diag([-1.0, -1, 1, 1])
        nibabel.save(nibabel.Nifti1Image(values.transpose(2, 1, 0), flip @ affine, header), path)
        return path
    if suffix == ".nrrd":
        vectors = " ".join(
            f"({','.join(f'{v:.17g}' for v in axis * s)})" for axis, s in zip(columns, image.GetSpacing(), strict=True)
        )
        head = (
            f"NRRD0004\ntype: int16\ndimension: 3\nspace: left-posterior-superior\nsizes: 8 9 7\nencoding: raw\n"
            f"endian: big\nspace directions: {vectors}\nspace origin: ({','.join(map(str, origin))})\n\n"
        )
    else:
        head = (
            f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = True\n"
            f"TransformMatrix = {' '.join(f'{v:.17g}' for v in columns.ravel())}\n"
            f"Offset = {' '.join(map(str, origin))}\n"
            f"ElementSpacing = {' '.join(map(str, image.GetSpacing()))}\nDimSize = 8 9 7\n"
            "ElementType = MET_SHORT\nElementDataFile = LOCAL\n"
        )
    path.write_bytes(head.encode() + values.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".nii", ".nrrd", ".mha"])
@pytest.mark.parametrize("direction", ["oblique", "oblique left-handed"])
def test_big_endian_files(tmp_path: Path, suffix: str, direction: str) -> None:
    image = ct_image(DIRECTIONS[direction])
    volume = read_ct(big_endian(tmp_path, suffix, image))
    assert volume.data.aminmax() == (-1000, 1200)
    np.testing.assert_allclose(brightest_point(volume), image.TransformIndexToPhysicalPoint(BRIGHT), atol=1e-4)


@pytest.mark.parametrize("dtype", [np.int32, np.float32, np.int16])
def test_voxel_types(tmp_path: Path, dtype: type) -> None:
    sitk.WriteImage(ct_image(dtype=dtype), str(tmp_path / "ct.nii.gz"))
    assert read_ct(tmp_path / "ct.nii.gz").data.aminmax() == (-1000, 1200)


def write_series(folder: Path, uid: str = "1.2.3") -> sitk.Image:
    """The CT as a DICOM series whose files are named against the order of the slices."""
    folder.mkdir(exist_ok=True)
    image = ct_image()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for z in range(image.GetDepth()):
        single = image[:, :, z]
        for tag, value in {
            "0008|0060": "CT",
            "0008|0018": f"{uid}.{z + 1}",
            "0020|000d": "1.2",
            "0020|000e": uid,
            "0020|0032": "\\".join(str(v) for v in image.TransformIndexToPhysicalPoint((0, 0, z))),
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0020|0013": str(z),
            "0028|1052": "0",
            "0028|1053": "1",
        }.items():
            single.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{uid}_{99 - z}.dcm"))
        writer.Execute(single)
    return image


def test_dicom_series(tmp_path: Path) -> None:
    image = write_series(tmp_path / "series")
    volume = read_ct(tmp_path / "series")
    assert tuple(volume.data.shape) == (7, 9, 8)
    np.testing.assert_allclose(brightest_point(volume), image.TransformIndexToPhysicalPoint(BRIGHT), atol=1e-5)


def test_real_headers(data_folder: Path) -> None:
    """Three scans as found, with int32 and sform only, int16, and float with qform only."""
    for name in ("totalsegmentator_hip_nail", "ibsi_sts_020", "ibsi_sts_044"):
        volume = read_ct(data_folder / "ct" / f"{name}.nii.gz")
        assert (volume.lps_from_index[:3, :3].diagonal() > 0).all()
    nailed = read_ct(data_folder / "ct" / "totalsegmentator_hip_nail.nii.gz")
    metal = (nailed.data > 2500).nonzero().double().mean(0).flip(0)
    left_of_the_middle = nailed.lps_from_index[:3, :3] @ metal + nailed.lps_from_index[:3, 3] - nailed.centre()
    assert left_of_the_middle[0] > 30  # the nail is in the left hip


def damaged(kind: str, folder: Path) -> Path:
    """A CT that is wrong in the way of `kind`."""
    path = folder / "ct.nii.gz"
    image = ct_image()
    if kind == "text":
        path.write_text("not an image", encoding="utf-8")
    elif kind == "flat":
        sitk.WriteImage(image[:, :, 2], str(path))
    elif kind == "nan":
        array = sitk.GetArrayFromImage(ct_image(dtype=np.float32))
        array[0, 0, 0] = np.nan
        sitk.WriteImage(sitk.GetImageFromArray(array), str(path))
    elif kind == "constant":
        sitk.WriteImage(image * 0 + 3, str(path))
    elif kind == "attenuation":
        sitk.WriteImage((sitk.Cast(image, sitk.sitkFloat32) + 1000) * 2e-5, str(path))
    elif kind == "unscaled":
        sitk.WriteImage(image + 1024, str(path))
    elif kind == "empty folder":
        path = folder
    elif kind == "complex":
        path = folder / "ct.nrrd"
        sitk.WriteImage(sitk.RealAndImaginaryToComplex(*[sitk.Cast(image, sitk.sitkFloat32)] * 2), str(path))
    elif kind == "two series":
        path = folder / "series"
        write_series(path, "1.2.3")
        write_series(path, "1.2.4")
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such file"),
        ("text", "cannot be read"),
        ("flat", "3-D volume"),
        ("nan", "not finite"),
        ("constant", "every voxel is 3"),
        ("attenuation", "Hounsfield"),
        ("unscaled", "Hounsfield"),
        ("empty folder", "no DICOM series"),
        ("two series", "2 DICOM series"),
        ("complex", "complex values, but real ones were expected"),
    ],
)
def test_bad_ct(tmp_path: Path, kind: str, message: str) -> None:
    path = damaged(kind, tmp_path)
    with pytest.raises(InputError, match=message) as raised:
        read_ct(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def nifti(dtype: str, kind: type = nibabel.Nifti1Image, nan: bool = False) -> nibabel.Nifti1Image:
    """A CT of bone with one voxel of fat, or of nothing that is a number."""
    values = np.full((8, 9, 7), 1200, dtype)
    values[2, 5, 4] = np.nan if nan else -200
    return kind(values, np.diag([-1.0, -1.0, 2.0, 1.0]), dtype=dtype)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".hdr"])
@pytest.mark.parametrize("dtype", ["float32", "float64", ">f4", "complex64", "complex128"])
def test_values_that_are_not_finite_are_found_in_every_nifti(tmp_path: Path, suffix: str, dtype: str) -> None:
    """ITK's own reader would turn them into zero."""
    path = tmp_path / f"ct{suffix}"
    nibabel.save(nifti(dtype, nibabel.Nifti1Pair if suffix == ".hdr" else nibabel.Nifti1Image, nan=True), path)
    for read in (read_volume, read_label_map):
        with pytest.raises(InputError, match=r"ct\.(nii|nii\.gz|hdr): holds values that are not finite"):
            read(path)


@pytest.mark.parametrize("suffix", [".mha", ".nrrd"])
def test_values_that_are_not_finite_are_found_in_label_maps_of_other_formats(tmp_path: Path, suffix: str) -> None:
    values = np.zeros((3, 4, 5), np.float32)
    values[1, 1, 1] = np.nan
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / f"labels{suffix}"))
    with pytest.raises(InputError, match="whole numbers from 0 to 65535"):
        read_label_map(tmp_path / f"labels{suffix}")


@pytest.mark.parametrize("dtype", ["int16", ">i2", "int32", "float32", "float64"])
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_a_nifti_that_is_cut_off_is_refused(tmp_path: Path, suffix: str, dtype: str) -> None:
    """ITK's own reader would fill it up with zeros, which as HU are water."""
    path = tmp_path / f"ct{suffix}"
    nibabel.save(nifti(dtype), path)
    content = path.read_bytes()
    for share in (0.5, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match="cannot be read as NIfTI") as raised:
            read_volume(path)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("axis", "size"), [(2, 0.0), (1, 4.0)])
def test_a_nifti_whose_voxels_have_two_sizes_is_refused(axis: int, size: float, tmp_path: Path) -> None:
    """ITK reads 1 mm where `pixdim` is 0, though the axes of the sform say 2 mm."""
    image = nibabel.Nifti1Image(np.zeros((4, 5, 6), np.int16), np.diag([2.0, 2.0, 3.0, 1.0]))
    image.header["qform_code"] = 0
    image.header["sform_code"] = 1
    nibabel.save(image, tmp_path / "ct.nii")
    read_volume(tmp_path / "ct.nii")
    content = bytearray((tmp_path / "ct.nii").read_bytes())
    content[76 + 4 * axis : 80 + 4 * axis] = np.float32(size).tobytes()  # pixdim
    (tmp_path / "ct.nii").write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"ct\.nii: its header tells voxels of"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (80, -1.0, "a negative size of voxels"),  # pixdim[1]
        (80, 1.004, None),  # of few voxels: a hundredth of a millimetre
        (116, -1024.0, "scaled by 0 and -1024 to be added"),  # scl_inter; scl_slope is 0
    ],
)
def test_headers_of_nifti_that_programs_read_in_two_ways(
    tmp_path: Path, place: int, value: float, says: str | None
) -> None:
    path = tmp_path / "ct.nii"
    nibabel.save(nibabel.Nifti1Image(np.zeros((5, 5, 5), np.int16), np.diag([-1.0, -1.0, 1.0, 1.0])), path)
    content = bytearray(path.read_bytes())
    content[112:120] = struct.pack("<2f", 0, 0)
    content[place : place + 4] = struct.pack("<f", value)
    path.write_bytes(content)
    if says is None:
        read_volume(path)
        return
    with pytest.raises(InputError, match=says):
        read_volume(path)
    (tmp_path / "packed.nii.gz").write_bytes(gzip.compress(bytes(content)))
    with pytest.raises(InputError, match=says):
        read_volume(tmp_path / "packed.nii.gz")


def test_a_small_error_of_the_size_of_voxels_adds_up(tmp_path: Path) -> None:
    path = tmp_path / "ct.nii"
    nibabel.save(nibabel.Nifti1Image(np.zeros((200, 5, 5), np.int16), np.diag([-1.0, -1.0, 1.0, 1.0])), path)
    content = bytearray(path.read_bytes())
    content[80:84] = struct.pack("<f", 1.004)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"its header tells voxels of 1\.004"):
        read_volume(path)


@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("missing", [1, 8, 9])
def test_a_compressed_nifti_whose_last_bytes_are_missing(dtype: str, missing: int, tmp_path: Path) -> None:
    """All voxels may still be there, but nothing tells that they are right."""
    nibabel.save(nifti(dtype), tmp_path / "ct.nii.gz")
    (tmp_path / "ct.nii.gz").write_bytes((tmp_path / "ct.nii.gz").read_bytes()[:-missing])
    with pytest.raises(InputError, match="cannot be read as NIfTI"):
        read_volume(tmp_path / "ct.nii.gz")


def test_a_nifti_that_only_claims_to_be_compressed_is_refused(tmp_path: Path) -> None:
    nibabel.save(nifti("int16"), tmp_path / "ct.nii")
    (tmp_path / "ct.nii").rename(tmp_path / "ct.nii.gz")
    with pytest.raises(InputError, match=r"is not compressed, and its name says so. Rename it to ct.nii\."):
        read_ct(tmp_path / "ct.nii.gz")


def test_a_compressed_nifti_whose_name_does_not_say_so_is_to_be_renamed(tmp_path: Path) -> None:
    nibabel.save(nifti("int16"), tmp_path / "ct.nii.gz")
    (tmp_path / "ct.nii.gz").rename(tmp_path / "ct.nii")
    with pytest.raises(InputError, match=r"is compressed, and its name does not say so\. Rename it to ct\.nii\.gz\."):
        read_ct(tmp_path / "ct.nii")


def test_a_nifti_compressed_in_several_parts_is_read(tmp_path: Path) -> None:
    """As by bgzip: the end of the file tells the size of the last part only."""
    nibabel.save(nifti("int16"), tmp_path / "ct.nii")
    content = (tmp_path / "ct.nii").read_bytes()
    (tmp_path / "ct.nii.gz").write_bytes(gzip.compress(content[:500]) + gzip.compress(content[500:]))
    assert torch.equal(read_ct(tmp_path / "ct.nii.gz").data, read_ct(tmp_path / "ct.nii").data)


def test_finite_floats_and_relatives_of_nifti_1(tmp_path: Path) -> None:
    nibabel.save(nifti("float64"), tmp_path / "ct.nii.gz")
    assert read_ct(tmp_path / "ct.nii.gz").data.aminmax() == (-200, 1200)
    nibabel.save(nifti("int16", nibabel.Nifti2Image), tmp_path / "ct2.nii.gz")
    with pytest.raises(InputError, match=r"is a NIfTI-2 file\. Save it as NIfTI-1"):
        read_ct(tmp_path / "ct2.nii.gz")
    analyze = nibabel.Spm2AnalyzeImage(nifti("int16").get_fdata().astype(np.int16), np.eye(4))
    nibabel.save(analyze, tmp_path / "old.img")
    with pytest.raises(InputError, match=r"old\.hdr: is an Analyze file, which does not say where left is"):
        read_ct(tmp_path / "old.hdr")


def label_image(direction: np.ndarray = DIRECTIONS["LPS"]) -> sitk.Image:
    return sitk.Cast(ct_image(direction) > 0, sitk.sitkUInt8) * 5


def test_labels_in_another_index_order_come_back_on_the_grid_of_the_ct(tmp_path: Path) -> None:
    sitk.WriteImage(ct_image(OBLIQUE), str(tmp_path / "ct.nii.gz"))
    sitk.WriteImage(sitk.DICOMOrient(label_image(OBLIQUE), "RAS"), str(tmp_path / "labels.nii.gz"))
    ct = read_ct(tmp_path / "ct.nii.gz")
    labels = read_labels(tmp_path / "labels.nii.gz", ct)
    assert labels.data.dtype == torch.uint8
    assert torch.equal(labels.data == 5, ct.data > 0)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd"])
@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32, np.float64])
def test_labels_up_to_65535_are_read_and_found(tmp_path: Path, suffix: str, dtype: type) -> None:
    sitk.WriteImage(ct_image(), str(tmp_path / "ct.nii.gz"))
    values = sitk.GetArrayFromImage(label_image()).astype(np.int64) * 13107  # 5 becomes 65535
    values[0, 0, :2] = 300
    image = sitk.GetImageFromArray(values.astype(dtype))
    image.CopyInformation(ct_image())
    sitk.WriteImage(image, str(tmp_path / f"labels{suffix}"))
    ct = read_ct(tmp_path / "ct.nii.gz")
    labels = read_labels(tmp_path / f"labels{suffix}", ct)
    assert labels.data.dtype == torch.int32
    assert torch.equal(labels.data == 65535, ct.data > 0)
    assert labels.data.unique().tolist() == [0, 300, 65535]
    bone = structure_attenuation(ct, labels, [65535], grow_voxels=0)
    np.testing.assert_allclose(brightest_point(bone), ct_image().TransformIndexToPhysicalPoint(BRIGHT), atol=1e-5)
    np.testing.assert_allclose(
        label_box_centre(labels, [65535]), ct_image().TransformIndexToPhysicalPoint(BRIGHT), atol=1e-5
    )
    write_volume(tmp_path / "again.nrrd", labels)
    assert torch.equal(read_labels(tmp_path / "again.nrrd", ct).data, labels.data)


def wrong_labels(kind: str) -> sitk.Image:
    labels = label_image()
    if kind == "elsewhere":
        labels.SetOrigin((40.0, -13.0, 200.0))
    if kind == "empty":
        return labels * 0
    if kind == "fractions":
        return sitk.Cast(labels, sitk.sitkFloat32) * 0.9
    if kind == "negative":
        return sitk.Cast(labels, sitk.sitkInt16) - 1
    if kind == "too large":
        return sitk.Cast(labels, sitk.sitkInt32) * 13108
    return labels


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("elsewhere", "nothing of the label map lies in the CT"),
        ("empty", "is empty: no voxel has a label"),
        ("fractions", "whole numbers"),
        ("negative", "whole numbers"),
        ("too large", "whole numbers from 0 to 65535 was expected, found 0 to 65540"),
    ],
)
def test_bad_labels(tmp_path: Path, kind: str, message: str) -> None:
    sitk.WriteImage(ct_image(), str(tmp_path / "ct.nii.gz"))
    sitk.WriteImage(wrong_labels(kind), str(tmp_path / "labels.nii.gz"))
    with pytest.raises(InputError, match=message):
        read_labels(tmp_path / "labels.nii.gz", read_ct(tmp_path / "ct.nii.gz"))


@pytest.mark.parametrize("kind", ["cropped", "coarser", "turned"])
def test_a_label_map_on_another_grid_is_resampled_by_nearest_neighbour(tmp_path: Path, kind: str) -> None:
    """Against SimpleITK's own values at the centres of the CT's voxels."""
    sitk.WriteImage(ct_image(OBLIQUE), str(tmp_path / "ct.nii.gz"))
    values = np.random.default_rng(2).integers(0, 6, (7, 9, 8)).astype(np.uint8)
    labels = sitk.GetImageFromArray(values)
    labels.CopyInformation(ct_image(OBLIQUE))
    if kind == "cropped":
        labels = labels[1:7, 2:, :6]
    elif kind == "coarser":
        labels.SetSpacing((1.7, 1.9, 4.0))
    else:
        labels.SetDirection((Rotation.from_euler("z", 30, degrees=True).as_matrix() @ OBLIQUE).ravel().tolist())
    sitk.WriteImage(labels, str(tmp_path / "labels.nrrd"))
    ct = read_ct(tmp_path / "ct.nii.gz")
    found, told, _ = read_labels_told(tmp_path / "labels.nrrd", ct)
    assert found.lps_from_index is ct.lps_from_index
    for z, y, x in np.ndindex(*found.data.shape):
        point = (ct.lps_from_index @ torch.tensor([x, y, z, 1.0], dtype=torch.float64))[:3].tolist()
        index = np.array(labels.TransformPhysicalPointToContinuousIndex(point))
        if abs(index - np.floor(index) - 0.5).min() < 1e-4:
            continue  # half-way between two voxels, either is right
        inside = ((index > -0.5) & (index < np.array(labels.GetSize()) - 0.5)).all()
        nearest = np.rint(index).astype(int).tolist()
        assert found.data[z, y, x] == (labels[nearest] if inside else 0)
    assert "labels.nrrd has a grid of its own" in told[0]
    assert "resampled by nearest neighbour" in told[0]


@pytest.mark.parametrize(("voxels", "half"), [((0.5, 0.5, 0.5), True), ((-0.5, 0.5, -0.5), True), ((0, 0, 1), False)])
def test_a_map_with_the_voxels_of_its_ct_and_another_origin_is_doubted(
    tmp_path: Path, voxels: tuple[float, float, float], half: bool
) -> None:
    ct = Volume(torch.zeros(6, 7, 8), torch.eye(4, dtype=torch.float64))
    labels = sitk.Image(8, 7, 6, sitk.sitkUInt8) + 1
    sitk.WriteImage(labels, str(tmp_path / "same.nrrd"))
    labels.SetOrigin(voxels)
    sitk.WriteImage(labels, str(tmp_path / "moved.nrrd"))
    sitk.WriteImage(labels[:, :, 1:], str(tmp_path / "cropped.nrrd"))
    assert read_labels_told(tmp_path / "same.nrrd", ct).against == ()
    assert read_labels_told(tmp_path / "cropped.nrrd", ct).against == ()
    (told,) = read_labels_told(tmp_path / "moved.nrrd", ct).against
    by = ", ".join(f"{each:.2f}" for each in voxels)
    assert f"moved.nrrd has as many voxels as the CT, as large and along the same axes, but lies ({by}) mm LPS" in told
    assert ("taken for a corner" in told) == half


@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".nrrd"])
def test_written_volumes_come_back(tmp_path: Path, suffix: str) -> None:
    affine = axis_aligned((0.8, 0.9, 2.5), (-40.0, 13.0, 200.0))
    affine[:3, :3] = torch.from_numpy(OBLIQUE) @ affine[:3, :3]
    data = torch.from_numpy(np.random.default_rng(1).integers(-1000, 1500, (7, 9, 8))).float()
    write_volume(tmp_path / f"ct{suffix}", Volume(data, affine))
    again = read_ct(tmp_path / f"ct{suffix}")
    assert torch.equal(again.data, data)
    torch.testing.assert_close(again.lps_from_index, affine, atol=1e-5, rtol=0)
    assert [p.name for p in tmp_path.iterdir()] == [f"ct{suffix}"]


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha"])
@pytest.mark.parametrize("missing", [1, 5, 3000])
def test_a_volume_that_a_full_disk_cuts_off_is_told_and_not_kept(suffix: str, missing: int, tmp_path: Path) -> None:
    noise = torch.randint(-1000, 1000, (20, 20, 20), generator=torch.Generator().manual_seed(1)).to(torch.int16)
    volume, path = Volume(noise, torch.eye(4, dtype=torch.float64)), tmp_path / f"ct{suffix}"
    write_volume(path, volume)
    size = path.stat().st_size
    path.unlink()
    with full_after(size - missing), pytest.raises(OSError, match="cannot be written") as told:
        write_volume(path, volume)
    assert told.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


def test_real_landmarks_lie_in_the_bones_of_their_side(data_folder: Path) -> None:
    """CT, labels and landmarks of one patient, read by three readers, meet in space."""
    folder = data_folder / "cases" / "bmf"
    ct = read_ct(folder / "ct.nii.gz")
    labels = read_labels(folder / "labels.nii.gz", ct)
    landmarks = read_landmarks(folder / "landmarks.json")
    check_inside(landmarks, ct)
    ids = label_table("femoreg")
    for name, femur in (("FH-l", "femur_left"), ("FH-r", "femur_right")):
        x, y, z = torch.linalg.solve(ct.lps_from_index, torch.cat([landmarks[name], torch.ones(1)]))[:3].round().long()
        assert (labels.data[z, y, x],) == ids[femur]
    left = structure_attenuation(ct, labels, ids["femur_left"]).centre()
    assert left[0] > 0  # patient left is +x
    assert landmarks["ASIS-l"][1] < landmarks["GSN-l"][1]  # back is +y
    assert landmarks["ASIS-l"][2] > landmarks["IPS-l"][2]  # up is +z
