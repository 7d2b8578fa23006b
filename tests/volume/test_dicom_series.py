"""CTs and segmentations in DICOM, as pydicom and highdicom write them, against the points that their headers tell."""

import re
from pathlib import Path

import highdicom
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
from highdicom.legacy import LegacyConvertedEnhancedCTImage
from highdicom.seg import Segmentation, SegmentDescription
from pydicom.dataset import FileMetaDataset
from pydicom.sr.codedict import codes
from pydicom.uid import (
    CTImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEGLSLossless,
    RLELossless,
    generate_uid,
)
from scipy.spatial.transform import Rotation

from femoreg_torch.errors import InputError
from femoreg_torch.intake import inspect_path
from femoreg_torch.volume import (
    Volume,
    read_ct,
    read_ct_told,
    read_label_map,
    read_labels_told,
    read_volume,
    read_volume_told,
    segment_names,
)
from femoreg_torch.volume.dicom.series import series_in

SIZE = (7, 9, 8)  # slices, rows, columns
PIXEL, STEP_MM = (0.9, 0.8), 2.5  # row spacing, column spacing
ORIGIN = np.array([-40.0, 13.0, 200.0])
AXIAL = np.eye(3)
NO_LEAN = np.zeros(3)
OBLIQUE = Rotation.from_euler("xyz", [12, -8, 20], degrees=True).as_matrix()
STUDY, FRAME = generate_uid(), generate_uid()
VALUES = np.random.default_rng(3).integers(0, 3000, SIZE).astype(np.int16)  # HU + 1024


def points_of(axes: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """Positions (slices, rows, columns, 3) of all voxels, LPS mm, by the formula of DICOM PS3.3, C.7.6.2.1.1."""
    k, j, i = np.meshgrid(*(np.arange(n) for n in SIZE), indexing="ij")
    step = STEP_MM * axes[:, 2] + lean
    return ORIGIN + i[..., None] * PIXEL[1] * axes[:, 0] + j[..., None] * PIXEL[0] * axes[:, 1] + k[..., None] * step


def write_series(
    folder: Path,
    axes: np.ndarray = AXIAL,
    *,
    lean: np.ndarray = NO_LEAN,
    values: np.ndarray = VALUES,
    slope: float = 1.0,
    syntax: str = ExplicitVRLittleEndian,
    number: int = 3,
    description: str = "Hip 2.5 B60",
    without: tuple[int, ...] = (),
    **tags: object,
) -> list[pydicom.Dataset]:
    """A CT with a file for each slice, whose names run against the order of the slices."""
    folder.mkdir(exist_ok=True)
    uid, datasets = generate_uid(), []
    for k in range(len(values)):
        if k in without:
            continue
        meta = FileMetaDataset()
        meta.TransferSyntaxUID = ExplicitVRLittleEndian if syntax in (RLELossless, JPEGLSLossless) else syntax
        data = pydicom.Dataset()
        data.file_meta = meta
        data.SOPClassUID = meta.MediaStorageSOPClassUID = CTImageStorage
        data.SOPInstanceUID = meta.MediaStorageSOPInstanceUID = generate_uid()
        data.StudyInstanceUID, data.SeriesInstanceUID, data.FrameOfReferenceUID = STUDY, uid, FRAME
        data.PatientID, data.PatientName, data.PatientBirthDate, data.PatientSex = "p", "Simulated^Hip", "", ""
        data.StudyID, data.StudyDate, data.StudyTime, data.AccessionNumber = "1", "20260101", "120000", ""
        data.ReferringPhysicianName, data.PositionReferenceIndicator = "", ""
        data.Modality, data.SeriesNumber, data.SeriesDescription = "CT", number, description
        data.InstanceNumber, data.ImageType = k + 1, ["ORIGINAL", "PRIMARY", "AXIAL"]
        data.Rows, data.Columns = values.shape[1:]
        data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
        data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 1
        data.RescaleSlope, data.RescaleIntercept = slope, -1024
        data.PixelSpacing, data.SliceThickness = list(PIXEL), STEP_MM
        data.ImageOrientationPatient = [f"{v:.12f}" for v in (*axes[:, 0], *axes[:, 1])]
        data.ImagePositionPatient = [f"{v:.10f}" for v in ORIGIN + k * (STEP_MM * axes[:, 2] + lean)]
        order = ">i2" if syntax == ExplicitVRBigEndian else "<i2"
        data.PixelData = values[k].astype(order).tobytes()
        data["PixelData"].VR = "OW"
        for tag, value in tags.items():
            setattr(data, tag, value)
        if syntax in (RLELossless, JPEGLSLossless):
            data.compress(syntax)
        data.save_as(folder / f"IM{100 + number * 50 - k:04d}", enforce_file_format=True)
        datasets.append(data)
    return datasets


def sampled(volume: Volume, points: np.ndarray) -> np.ndarray:
    """Values at points (..., 3) that lie on voxel centres."""
    index = np.einsum(
        "ij,...j->...i",
        np.linalg.inv(volume.lps_from_index.numpy()),
        np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1),
    )[..., :3]
    assert abs(index - np.rint(index)).max() < 1e-4
    x, y, z = np.moveaxis(np.rint(index).astype(int), -1, 0)
    return volume.data.numpy()[z, y, x]


@pytest.mark.parametrize(
    "syntax",
    [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, RLELossless, JPEGLSLossless],
    ids=["explicit", "implicit", "big-endian", "RLE", "JPEG-LS"],
)
def test_every_voxel_of_an_oblique_series_is_in_its_place(tmp_path: Path, syntax: str) -> None:
    write_series(tmp_path / "ct", OBLIQUE, syntax=syntax)
    volume, told = read_ct_told(tmp_path / "ct")
    assert told == ()
    np.testing.assert_array_equal(sampled(volume, points_of(OBLIQUE, NO_LEAN)), VALUES - 1024)


@pytest.mark.parametrize(
    "axes",
    [AXIAL, np.stack([-AXIAL[0], -AXIAL[1], AXIAL[2]], 1), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])],
    ids=["supine", "prone", "sagittal"],
)
def test_index_axes_end_along_left_back_and_head(tmp_path: Path, axes: np.ndarray) -> None:
    write_series(tmp_path / "ct", axes)
    volume = read_ct(tmp_path / "ct")
    assert (volume.lps_from_index[:3, :3].diagonal() > 0.5).all()
    np.testing.assert_array_equal(sampled(volume, points_of(axes, NO_LEAN)), VALUES - 1024)


@pytest.mark.parametrize("compressor", ["JPEG", "JPEG2000", "JPEGLS"])
def test_series_that_gdcm_compressed(tmp_path: Path, compressor: str) -> None:
    """Lossless JPEG, JPEG 2000 and JPEG-LS, as SimpleITK writes them; headers then as pydicom writes them."""
    folder = tmp_path / "ct"
    for number, data in enumerate(write_series(folder, OBLIQUE)):
        path = folder / f"IM{250 - number:04d}"
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.UseCompressionOn()
        writer.SetCompressor(compressor)
        writer.SetImageIO("GDCMImageIO")
        image = sitk.Cast(sitk.ReadImage(str(path)), sitk.sitkInt16)
        writer.SetFileName(str(tmp_path / "one.dcm"))
        writer.Execute(image)
        packed = pydicom.dcmread(tmp_path / "one.dcm")
        assert packed.file_meta.TransferSyntaxUID.is_compressed
        packed.SeriesInstanceUID, packed.SOPInstanceUID = data.SeriesInstanceUID, data.SOPInstanceUID
        packed.ImagePositionPatient, packed.PixelSpacing = data.ImagePositionPatient, data.PixelSpacing
        packed.ImageOrientationPatient = data.ImageOrientationPatient
        packed.save_as(path)
    np.testing.assert_array_equal(sampled(read_ct(folder), points_of(OBLIQUE, NO_LEAN)), VALUES - 1024)


def test_an_enhanced_ct_in_one_file(tmp_path: Path) -> None:
    slices = write_series(tmp_path / "ct", OBLIQUE)
    for data in slices:
        data.KVP, data.ContrastBolusAgent, data.BodyPartExamined = 120, "", "HIP"
    whole = LegacyConvertedEnhancedCTImage(
        legacy_datasets=slices,
        series_instance_uid=generate_uid(),
        series_number=7,
        sop_instance_uid=generate_uid(),
        instance_number=1,
    )
    (tmp_path / "enhanced").mkdir()
    whole.save_as(tmp_path / "enhanced" / "one.dcm")
    volume = read_ct(tmp_path / "enhanced")
    np.testing.assert_array_equal(sampled(volume, points_of(OBLIQUE, NO_LEAN)), VALUES - 1024)


def test_fractional_rescale(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", slope=0.25, values=4 * VALUES)
    np.testing.assert_array_equal(sampled(read_ct(tmp_path / "ct"), points_of(AXIAL, NO_LEAN)), VALUES - 1024)


def test_a_tilted_gantry_is_straightened(tmp_path: Path) -> None:
    """A linear function of space, sampled in sheared slices, comes back as that function."""
    tilt = np.radians(15)
    axes = Rotation.from_euler("x", tilt).as_matrix()
    lean = STEP_MM * (np.array([0, 0, 1 / np.cos(tilt)]) - axes[:, 2])  # the table moves along z
    points = points_of(axes, lean)
    values = np.rint(500 + 40 * (points - ORIGIN) @ [1.0, 2.0, 1.5]).astype(np.int16)
    write_series(tmp_path / "ct", axes, lean=lean, values=values)
    volume, told = read_ct_told(tmp_path / "ct")
    assert "tilted by 15.0°" in told[0]
    index = np.stack(np.meshgrid(*(np.arange(n) for n in volume.data.shape[::-1]), indexing="ij"), -1).reshape(-1, 3)
    where = index @ volume.lps_from_index[:3, :3].numpy().T + volume.lps_from_index[:3, 3].numpy()
    found = volume.data.numpy()[tuple(index[:, ::-1].T)]
    height = (where - ORIGIN) @ axes[:, 2] / STEP_MM
    stored = (where - ORIGIN - height[:, None] * lean) @ axes / [PIXEL[1], PIXEL[0], STEP_MM]
    inside = ((stored > -1e-6) & (stored < np.array(SIZE[::-1]) - 1 + 1e-6)).all(1)
    assert inside.sum() > 0.8 * values.size
    assert (found[(stored < -0.6).any(1)] == -1024).all()
    np.testing.assert_allclose(found[inside], (500 - 1024 + 40 * (where - ORIGIN) @ [1.0, 2.0, 1.5])[inside], atol=1)


@pytest.mark.parametrize(("tilt_deg", "straightened"), [(0.02, False), (0.3, True), (1.0, True)])
def test_a_slight_tilt_of_the_gantry_adds_up_over_many_slices(
    tmp_path: Path, tilt_deg: float, straightened: bool
) -> None:
    """A degree shears a CT of 300 mm by 5 mm."""
    count, tilt = 121, np.radians(tilt_deg)
    axes = Rotation.from_euler("x", tilt).as_matrix()
    lean = STEP_MM * (np.array([0, 0, 1 / np.cos(tilt)]) - axes[:, 2])
    k, row, column = np.meshgrid(np.arange(count), np.arange(14), np.arange(5), indexing="ij")
    along = np.stack([column * PIXEL[1], row * PIXEL[0], k * STEP_MM], -1)
    places = along @ axes.T + k[..., None] * lean  # from the centre of the first voxel
    write_series(tmp_path / "ct", axes, lean=lean, values=np.rint(5000 + 40 * places[..., 1]).astype(np.int16))
    volume, told = read_volume_told(tmp_path / "ct")
    assert bool(told) == straightened
    x, y, z = volume.data.shape[2] // 2, volume.data.shape[1] // 2, volume.data.shape[0] - 2
    where = volume.lps_from_index.numpy() @ [x, y, z, 1]
    assert (float(volume.data[z, y, x]) + 1024 - 5000) / 40 == pytest.approx(where[1] - ORIGIN[1], abs=0.3)


def test_one_of_several_series_is_chosen(tmp_path: Path) -> None:
    folder = tmp_path / "dicom"
    write_series(folder, number=3)
    write_series(folder, number=5, description="Hip 1.0 B30", values=VALUES[::-1].copy())
    write_series(folder, number=1, description="Topogram", values=VALUES[:1], ImageType=["ORIGINAL", "LOCALIZER"])
    (folder / "README.txt").write_text("of the scanner", encoding="utf-8")
    assert [(one.number, len(one.slices)) for one in series_in(folder)] == [("1", 1), ("3", 7), ("5", 7)]
    with pytest.raises(InputError, match=r"holds 2 DICOM series.*series 3 “Hip 2.5 B60” \(CT, 7 files\), series 5"):
        read_ct(folder)
    for wanted in ("5", "1.0 b30"):
        assert read_ct_told(folder, wanted)[0].data[0, 0, 0] == VALUES[-1, 0, 0] - 1024
    assert read_ct(folder / "IM0250").data[0, 0, 0] == VALUES[0, 0, 0] - 1024  # a file stands for its series
    with pytest.raises(InputError, match="none of its series is '7'; there are: series 1"):
        read_ct_told(folder, "7")


@pytest.mark.parametrize("named", [{"number": 3}, {"number": 3, "SeriesNumber": None, "SeriesDescription": ""}])
def test_series_that_numbers_and_names_do_not_tell_apart_are_listed_with_what_does(named: dict, tmp_path: Path) -> None:
    folder = tmp_path / "dicom"
    write_series(folder, **named)
    for path in list(folder.iterdir()):
        path.rename(path.with_name(f"a{path.name}"))
    write_series(folder, **named)
    first, second = series_in(folder)
    with pytest.raises(InputError, match="holds 2 DICOM series") as told:
        read_ct(folder)
    assert first.uid in str(told.value)
    assert second.uid in str(told.value)
    inspected = " ".join(inspect_path(folder).facts)
    assert first.uid in inspected
    assert second.uid in inspected
    assert read_ct_told(folder, second.uid)[0].data.shape == SIZE


def test_a_scout_beside_one_series_is_passed_over_and_copies_count_once(tmp_path: Path) -> None:
    folder = tmp_path / "dicom"
    write_series(folder, number=3)
    write_series(folder, number=1, values=VALUES[:1], ImageType=["ORIGINAL", "LOCALIZER"])
    (folder / "copy").write_bytes((folder / "IM0250").read_bytes())
    assert read_ct(folder).data.shape == SIZE


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", r"2 of 7 slices are missing \(after IM0249, IM0247\), at steps of 2.5 mm"),
        ("doubled", r"7 slices from 2 acquisitions lie where another one lies"),
        ("uneven", "the slices are 2 to 2.5 mm apart"),
        ("sizes", "slices of several sizes"),
        ("turned", "another orientation or pixel spacing"),
        ("no position", "1 slices have no ImagePositionPatient"),
        ("one", "none of its DICOM series is a volume"),
        ("beside", "beside one straight line"),
        ("no intercept", r"1 of 7 slices have no RescaleIntercept \(IM0244, …\)"),
        ("not HU", "Hounsfield"),
    ],
)
def test_series_that_are_no_ct_are_told(tmp_path: Path, kind: str, message: str) -> None:
    folder = tmp_path / "ct"
    slices = write_series(
        folder, without=(2, 4) if kind == "missing" else (), values=VALUES[:1] if kind == "one" else VALUES
    )
    last = folder / "IM0244"
    if kind == "doubled":
        for n, data in enumerate(slices):
            data.AcquisitionNumber, data.SOPInstanceUID = 2, generate_uid()
            data.save_as(folder / f"second_{n}")
    elif kind == "no intercept":
        slices[-1].RescaleIntercept = None
        slices[-1].save_as(last)
    elif kind in ("uneven", "turned", "no position", "beside"):
        data = slices[-1]
        x, y, z = (float(v) for v in data.ImagePositionPatient)
        if kind == "uneven":
            data.ImagePositionPatient = [x, y, z - 0.5]
        elif kind == "beside":
            slices[3].ImagePositionPatient = [x, y + 3, ORIGIN[2] + 3 * STEP_MM]
            slices[3].save_as(folder / "IM0247")
        elif kind == "turned":
            data.ImageOrientationPatient = [1, 0, 0, 0, 0.9962, 0.0872]
        else:
            del data.ImagePositionPatient
        data.save_as(last)
    elif kind == "sizes":
        slices[0].Rows, slices[0].PixelData = 8, slices[0].PixelData[:128]
        slices[0].save_as(folder / "IM0250")
    elif kind == "not HU":
        for n, data in enumerate(slices):
            data.RescaleIntercept = 0
            data.save_as(folder / f"IM{250 - n:04d}")
    with pytest.raises(InputError, match=message) as raised:
        read_ct(folder)
    assert "\n" not in str(raised.value)


def described(number: int, label: str) -> SegmentDescription:
    return SegmentDescription(
        segment_number=number,
        segment_label=label,
        segmented_property_category=codes.SCT.Tissue,
        segmented_property_type=codes.SCT.Bone,
        algorithm_type=highdicom.seg.SegmentAlgorithmTypeValues.MANUAL,
    )


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_dicom_segmentations(tmp_path: Path, kind: str) -> None:
    """Two bones on an oblique CT; the segmentation holds only those slices that are not empty."""
    slices = write_series(tmp_path / "ct", OBLIQUE)
    masks = np.zeros((*SIZE, 2), np.uint8)
    masks[2:5, 1:4, 1:6, 0], masks[3:6, 5:, 2:, 1] = 1, 1
    shared = kind != "LABELMAP"
    if shared:
        masks[3, 3:6, 2:4, 1] = 1
    pixels = masks if shared else masks[..., 0] + 2 * masks[..., 1]
    seg = Segmentation(
        source_images=slices,
        pixel_array=pixels.astype(float) if kind == "FRACTIONAL" else pixels,
        segmentation_type=kind,
        segment_descriptions=[described(1, "Left femur"), described(2, "Left hip")],
        series_instance_uid=generate_uid(),
        series_number=9,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="test",
        manufacturer_model_name="test",
        software_versions="1",
        device_serial_number="1",
    )
    path = tmp_path / "bones.dcm"
    seg.save_as(path)
    assert segment_names(path) == {"Left femur": (1,), "Left hip": (2,)}
    ct = read_volume(tmp_path / "ct")
    labels, told, _ = read_labels_told(path, ct)
    expected = np.where(masks[..., 0] > 0, 1, 2 * masks[..., 1])
    np.testing.assert_array_equal(sampled(labels, points_of(OBLIQUE, NO_LEAN)), expected)
    assert any("lie in both Left femur and Left hip" in line for line in told) == shared
    assert labels.data.dtype in (torch.uint8, torch.int32)


def test_a_ct_is_no_segmentation(tmp_path: Path) -> None:
    write_series(tmp_path / "ct")
    with pytest.raises(InputError, match=r"a DICOM segmentation \(SEG\) was expected, found CT"):
        read_label_map(tmp_path / "ct" / "IM0250")


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("claimed", [2**32 - 2, 2 * SIZE[1] * SIZE[2] + 2, 0])
def test_slices_that_claim_more_pixels_than_they_hold(tmp_path: Path, syntax: str, claimed: int) -> None:
    """GDCM would take the memory that is claimed, gigabytes, and half a minute."""
    write_series(tmp_path / "ct", syntax=syntax)
    damaged = sorted((tmp_path / "ct").iterdir())[2]
    content = damaged.read_bytes()
    order = ">" if syntax == ExplicitVRBigEndian else "<"
    before, _, pixels = content.rpartition(np.array(2 * SIZE[1] * SIZE[2], f"{order}u4").tobytes())
    assert len(pixels) == 2 * SIZE[1] * SIZE[2]
    damaged.write_bytes(before + np.array(claimed, f"{order}u4").tobytes() + pixels)
    with pytest.raises(InputError, match=f"{damaged.name}: holds fewer pixels than it claims"):
        read_ct(tmp_path / "ct")


@pytest.mark.parametrize("kind", ["no series", "no modality", "one instance", "small letters"])
def test_what_anonymisers_leave_of_a_series_is_read(tmp_path: Path, kind: str) -> None:
    """Places, not names, make a volume; a scout beside it that tells its modality is still passed over."""
    folder = tmp_path / "ct"
    write_series(folder, number=1, values=VALUES[:1], ImageType=["ORIGINAL", "LOCALIZER"])
    tags = {"no modality": {"Modality": ""}, "small letters": {"Modality": "ct"}}.get(kind, {})
    for n, data in enumerate(write_series(folder, **tags)):
        if kind == "no series":
            del data.SeriesInstanceUID
        elif kind == "one instance":
            data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
        data.save_as(folder / f"IM{250 - n:04d}")
    np.testing.assert_allclose(sampled(read_ct(folder), points_of(AXIAL, NO_LEAN)), VALUES - 1024)
    if kind == "no series":
        assert read_ct(folder / "IM0250").data.shape == SIZE


@pytest.mark.parametrize("name", ["A_scout", "Z_scout"])
def test_a_scout_with_the_uid_of_the_volume_is_no_slice_of_it(tmp_path: Path, name: str) -> None:
    """Whether it comes first by name, or last."""
    folder = tmp_path / "ct"
    uid = write_series(folder)[0].SeriesInstanceUID
    (scout,) = write_series(tmp_path / "scout", values=VALUES[:1, :4], ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    scout.SeriesInstanceUID = uid
    scout.save_as(folder / name)
    np.testing.assert_allclose(sampled(read_ct(folder), points_of(AXIAL, NO_LEAN)), VALUES - 1024)
    assert [len(one.slices) for one in series_in(folder)] == [7]


def test_of_many_series_few_are_listed(tmp_path: Path) -> None:
    for n, data in enumerate(write_series(tmp_path / "ct", values=np.repeat(VALUES, 3, 0), Modality="CR")):
        data.SeriesInstanceUID = generate_uid()
        data.save_as(tmp_path / "ct" / f"IM{n}")
    with pytest.raises(InputError, match=r"there are: series 3 .* and \d+ more\. Choose") as raised:
        read_ct(tmp_path / "ct")
    assert len(str(raised.value)) < 1500


@pytest.mark.parametrize("modality", ["CT", "OT"])
def test_a_uid_for_each_slice_is_told_as_that(tmp_path: Path, modality: str) -> None:
    folder = tmp_path / "ct"
    for n, data in enumerate(write_series(folder, Modality=modality)):
        data.SeriesInstanceUID = generate_uid()
        data.save_as(folder / f"IM{250 - n:04d}")
    with pytest.raises(InputError, match="each of its 7 DICOM files has a SeriesInstanceUID of its own"):
        read_ct(folder)


def test_values_are_those_stored_however_they_are_shown(tmp_path: Path) -> None:
    """MONOCHROME1 says that low values are shown bright; GDCM and highdicom turn the values themselves over."""
    single, enhanced = tmp_path / "ct", tmp_path / "enhanced"
    enhanced.mkdir()
    whole = LegacyConvertedEnhancedCTImage(write_series(tmp_path / "usual"), generate_uid(), 1, generate_uid(), 1)
    whole.PhotometricInterpretation = "MONOCHROME1"
    whole.save_as(enhanced / "one")
    write_series(single, PhotometricInterpretation="MONOCHROME1")
    for folder in (single, enhanced):
        np.testing.assert_allclose(sampled(read_ct(folder), points_of(AXIAL, NO_LEAN)), VALUES - 1024)


def test_a_series_of_files_of_several_frames_is_told(tmp_path: Path) -> None:
    folder, uid = tmp_path / "enhanced", generate_uid()
    folder.mkdir()
    slices = write_series(tmp_path / "ct")
    for n, some in enumerate((slices[:4], slices[4:])):
        LegacyConvertedEnhancedCTImage(some, uid, 1, generate_uid(), n + 1).save_as(folder / str(n))
    with pytest.raises(InputError, match="has 2 files of several frames each"):
        read_ct(folder)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"PixelSpacing": [0, 0.8]}, "pixel spacing or orientation of IM.* is zero"),
        ({"BitsStored": 12, "HighBit": 15}, "its values end at bit 15 and have 12 bits"),
    ],
)
def test_headers_that_lead_its_reader_astray(tmp_path: Path, tags: dict, message: str) -> None:
    write_series(tmp_path / "ct", **tags)
    with pytest.raises(InputError, match=message):
        read_ct(tmp_path / "ct")


@pytest.mark.parametrize(
    ("tag", "other", "kinds"),
    [
        ("PatientID", "q", "patients"),
        ("PatientName", "Other^Hip", "patients"),
        ("StudyInstanceUID", "1.2.3", "studies"),
        ("FrameOfReferenceUID", "1.2.3", "frames of reference"),
    ],
)
@pytest.mark.parametrize("place", ["above", "between", "same"])
def test_a_series_of_two_patients_or_studies_is_refused(
    tmp_path: Path, tag: str, other: str, kinds: str, place: str
) -> None:
    """Whose slices lie above those of the first, or between them, where positions contradict nothing, or on them."""
    folder = tmp_path / "ct"
    uid = write_series(folder)[0].SeriesInstanceUID
    up = {"above": SIZE[0] * STEP_MM, "between": STEP_MM / 2, "same": 0.0}[place]
    for n, data in enumerate(write_series(tmp_path / "second", **{tag: other})):
        x, y, z = (float(v) for v in data.ImagePositionPatient)
        data.SeriesInstanceUID, data.ImagePositionPatient = uid, [x, y, z + up]
        data.save_as(folder / f"second_{n}")
    with pytest.raises(InputError, match=rf"14 files\) holds files of 2 {kinds}, by {tag}: 7 as IM0244; 7 as second_0"):
        read_ct(folder)


def test_names_that_anonymisers_give_each_file_are_no_mixture(tmp_path: Path) -> None:
    folder = tmp_path / "ct"
    for n, data in enumerate(write_series(folder)):
        data.PatientID, data.PatientName, data.FrameOfReferenceUID = (
            f"{n}",
            "" if n else "Simulated^Hip",
            generate_uid(),
        )
        data.save_as(folder / f"IM{250 - n:04d}")
    np.testing.assert_allclose(sampled(read_ct(folder), points_of(AXIAL, NO_LEAN)), VALUES - 1024)


def test_two_series_of_two_patients_are_told_as_that(tmp_path: Path) -> None:
    write_series(tmp_path / "ct")
    write_series(tmp_path / "ct", number=5, PatientID="q")
    with pytest.raises(InputError, match=r"holds 2 DICOM series of 2 patients \(PatientID\)"):
        read_ct(tmp_path / "ct")


@pytest.mark.parametrize(
    ("tags", "told"),
    [
        ({"SpacingBetweenSlices": 2.8}, "SpacingBetweenSlices .* is 2.8 mm, but the positions .* 2.5 mm apart"),
        ({"SpacingBetweenSlices": -2.5}, None),
        ({"SliceThickness": 1.25}, "are 1.25 mm thick and 2.5 mm apart"),  # as if every second file were there
        ({"SliceThickness": 5.0}, None),  # slices that overlap
    ],
)
def test_steps_that_other_tags_contradict_are_told(tmp_path: Path, tags: dict, told: str | None) -> None:
    write_series(tmp_path / "ct", **tags)
    volume, found = read_ct_told(tmp_path / "ct")
    assert volume.spacing_mm[2] == pytest.approx(STEP_MM)
    assert len(found) == (told is not None)
    assert told is None or re.search(told, found[0])


def test_a_tilted_gantry_may_tell_steps_along_the_table(tmp_path: Path) -> None:
    tilt = np.radians(15)
    axes = Rotation.from_euler("x", tilt).as_matrix()
    lean = STEP_MM * (np.array([0, 0, 1 / np.cos(tilt)]) - axes[:, 2])
    for said in (STEP_MM, STEP_MM / np.cos(tilt)):
        write_series(tmp_path / f"ct{said:.3f}", axes, lean=lean, SpacingBetweenSlices=f"{said:.4f}")
        assert [note[:14] for note in read_ct_told(tmp_path / f"ct{said:.3f}")[1]] == ["the gantry was"]
