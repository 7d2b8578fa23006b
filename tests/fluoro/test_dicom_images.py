"""DICOM X-ray images, as pydicom writes them: values, frames, and what the header says against a case."""

from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import (
    MPEG2MPML,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    RLELossless,
    SecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
)

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import (
    SOURCES,
    Circle,
    Display,
    Polygon,
    Tags,
    carm_settings,
    contradictions,
    may_be_image,
    read_header,
    read_stored,
)
from femoreg_torch.fluoro import settled_intensity as settled
from femoreg_torch.geometry import Camera, Uncertainty

PIXELS = np.random.default_rng(3).integers(1, 4096, (5, 7), dtype=np.uint16)
CAMERA = Camera(1000.0, (0.2, 0.2), (5, 7), (3.0, 2.0))


def write(folder: Path, pixels: np.ndarray = PIXELS, **fields: object) -> Path:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    path = folder / "run.dcm"
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    settings = {
        "SOPClassUID": meta.MediaStorageSOPClassUID,
        "SOPInstanceUID": "1.2.3",
        "Modality": "XA",
        "Rows": pixels.shape[-2],
        "Columns": pixels.shape[-1],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 8 * pixels.dtype.itemsize,
        "BitsStored": 12 if pixels.dtype.itemsize == 2 else 8,
        "HighBit": 11 if pixels.dtype.itemsize == 2 else 7,
        "PixelRepresentation": 0,
        "PixelData": pixels.tobytes() + b"\0" * (pixels.nbytes % 2),
    } | fields
    for name, value in settings.items():
        setattr(dataset, name, value)
    pydicom.dcmwrite(path, dataset)
    return path


def values(path: Path, **options: object) -> np.ndarray:
    return read_stored(path, **options).values.numpy()  # type: ignore[arg-type]


def test_bits_that_hold_no_pixel_are_left_out(tmp_path: Path) -> None:
    overlay = PIXELS | np.uint16(0xA000)  # as retired overlays in the upper bits
    np.testing.assert_array_equal(values(write(tmp_path, overlay)), PIXELS)
    shifted = (PIXELS << 4).astype(np.uint16) | np.uint16(0x000B)
    np.testing.assert_array_equal(values(write(tmp_path, shifted, HighBit=15)), PIXELS)
    signed = PIXELS.astype(np.int16) - 2048
    np.testing.assert_array_equal(values(write(tmp_path, signed & 0x0FFF, PixelRepresentation=1)), signed)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_all_depths_and_both_photometric_interpretations_give_one_image(tmp_path: Path, bits: int) -> None:
    dtype = np.uint8 if bits == 8 else np.uint16
    pixels = (PIXELS.astype(np.int64) * (2**bits - 1) // 4095).astype(dtype)
    depth = {"BitsStored": bits, "HighBit": bits - 1}
    plain = values(write(tmp_path, pixels, **depth))
    np.testing.assert_array_equal(plain, pixels)
    inverse = (2**bits - 1 - pixels.astype(np.int64)).astype(dtype)
    shown_so = write(tmp_path, inverse, PhotometricInterpretation="MONOCHROME1", **depth)
    np.testing.assert_array_equal(values(shown_so), plain)
    signed = {"PixelIntensityRelationship": "LIN", "PixelIntensityRelationshipSign": -1}
    np.testing.assert_array_equal(values(write(tmp_path, inverse, **depth, **signed)), plain)
    turned = {"RescaleSlope": -1, "RescaleIntercept": 2**bits - 1}  # of a file whose rescale turns them over itself
    np.testing.assert_array_equal(values(write(tmp_path, inverse, **depth, **signed, **turned)), plain)
    # The sign tells what is physical; how it is shown does not matter then.
    signed = {"PixelIntensityRelationship": "LIN", "PixelIntensityRelationshipSign": 1}
    raw = write(tmp_path, pixels, PhotometricInterpretation="MONOCHROME1", **depth, **signed)
    np.testing.assert_array_equal(values(raw), plain)


def lut(first: int, entries: np.ndarray) -> Dataset:
    item = Dataset()
    item.LUTDescriptor = [len(entries), first, 16]
    item.ModalityLUTType = "US"
    item.LUTData = entries.astype("<u2").tobytes()
    return item


def test_a_lut_brings_logarithms_back_to_intensities(tmp_path: Path) -> None:
    to_linear = np.round(60000 * np.exp((np.arange(4096) - 4095) / 900)).astype(np.uint16)
    expected = to_linear[PIXELS]
    path = write(tmp_path, PixelIntensityRelationship="LOG", ModalityLUTSequence=[lut(0, to_linear)])
    read = read_stored(path)
    np.testing.assert_array_equal(read.values.numpy(), expected)
    assert read.intensity == "raw"
    enhanced = lut(0, to_linear)
    enhanced.LUTFunction = "TO_LINEAR"
    path = write(tmp_path, PixelIntensityRelationship="LOG", PixelIntensityRelationshipLUTSequence=[enhanced])
    np.testing.assert_array_equal(values(path), expected)


@pytest.mark.parametrize(
    ("fields", "attenuation"),
    [
        ({}, PIXELS.max() - PIXELS.astype(int)),  # of XA: high where many photons arrive
        ({"PixelIntensityRelationshipSign": 1}, PIXELS.max() - PIXELS.astype(int)),
        ({"PixelIntensityRelationshipSign": -1}, PIXELS.astype(int) - PIXELS.min()),
        ({"PhotometricInterpretation": "MONOCHROME1"}, PIXELS.astype(int) - PIXELS.min()),
    ],
)
def test_logarithms_without_a_lut_have_bright_bone(tmp_path: Path, fields: dict, attenuation: np.ndarray) -> None:
    read = read_stored(write(tmp_path, PixelIntensityRelationship="LOG", **fields))
    np.testing.assert_array_equal(read.values.numpy(), attenuation)
    assert read.intensity == "log"
    assert "unknown base" in read.remarks[0]


@pytest.mark.parametrize("relationship", [{"PixelIntensityRelationship": "DISP"}, {"Modality": "DX"}])
@pytest.mark.parametrize("shown", ["MONOCHROME1", "MONOCHROME2"])
def test_a_sign_says_where_bone_is_dark_whatever_the_case_says_of_values(
    tmp_path: Path, relationship: dict, shown: str
) -> None:
    """A radiograph is shown with bone bright, so that its user says `log`."""
    for sign, light in ((1, PIXELS), (-1, 4095 - PIXELS)):
        signed = {"PhotometricInterpretation": shown, "PixelIntensityRelationshipSign": sign} | relationship
        read = read_stored(write(tmp_path, **signed))
        assert read.intensity is None
        np.testing.assert_array_equal(read.values_as("raw").numpy(), light)
        np.testing.assert_array_equal(read.values_as("log").numpy(), float(light.max()) - light)
    read = read_stored(write(tmp_path, PhotometricInterpretation=shown, **relationship))  # as it is shown
    np.testing.assert_array_equal(read.values_as("log").numpy(), PIXELS if shown == "MONOCHROME2" else 4095 - PIXELS)


@pytest.mark.parametrize("implicit", [True, False])
def test_a_file_without_a_preamble_is_an_image_too(tmp_path: Path, implicit: bool) -> None:
    """As older archives write them: neither a preamble nor what says how the elements are coded."""
    dataset = pydicom.dcmread(write(tmp_path))
    bare = Dataset({element.tag: element for element in dataset})
    path = tmp_path / "bare"
    bare.save_as(path, implicit_vr=implicit, little_endian=True, enforce_file_format=False)
    assert path.read_bytes()[:1] == b"\x08"
    assert may_be_image(path)
    np.testing.assert_array_equal(values(path), PIXELS)


def test_windows_are_for_looking_only(tmp_path: Path) -> None:
    path = write(tmp_path, WindowCenter=100, WindowWidth=50, VOILUTSequence=[lut(0, np.zeros(4096, np.uint16))])
    np.testing.assert_array_equal(values(path), PIXELS)


def test_frames_are_counted_from_one_and_averaged(tmp_path: Path) -> None:
    run = np.stack([PIXELS, PIXELS[::-1], PIXELS[:, ::-1]])
    path = write(tmp_path, run, NumberOfFrames=3)
    np.testing.assert_array_equal(values(path, frames=(2,)), PIXELS[::-1])
    np.testing.assert_allclose(values(path, frames=(1, 3)), (run[0].astype(float) + run[2]) / 2)
    np.testing.assert_allclose(values(path, frames="mean"), run.mean(0, dtype=np.float64), rtol=1e-6)
    inverse = write(tmp_path, (4095 - run).astype(np.uint16), NumberOfFrames=3, PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_allclose(values(inverse, frames="mean"), run.mean(0, dtype=np.float64), rtol=1e-6)
    with pytest.raises(InputError, match=r"no frame 4, it holds 3"):
        values(path, frames=(4,))
    with pytest.raises(InputError, match="the C-arm moved"):
        values(write(tmp_path, run, NumberOfFrames=3, PositionerMotion="DYNAMIC"), frames="mean")


@pytest.mark.parametrize("shown", ["MONOCHROME1", "MONOCHROME2"])
@pytest.mark.parametrize("compressor", ["JPEG", "JPEG2000", "JPEGLS"])  # the first is lossless, and frequent in XA
def test_compressed_images_are_the_same(tmp_path: Path, compressor: str, shown: str) -> None:
    """As SimpleITK packs them; unsigned 12 bits, a rescale and an inversion, which must not be applied twice."""
    pixels = np.random.default_rng(4).integers(0, 4096, (20, 12), dtype=np.uint16)
    writer = sitk.ImageFileWriter()
    writer.UseCompressionOn()
    writer.SetCompressor(compressor)
    writer.SetImageIO("GDCMImageIO")
    writer.SetFileName(str(tmp_path / "packed.dcm"))
    writer.Execute(sitk.GetImageFromArray(pixels))
    packed = pydicom.dcmread(tmp_path / "packed.dcm")
    assert packed.file_meta.TransferSyntaxUID.is_compressed
    fields = {"BitsStored": packed.BitsStored, "HighBit": packed.HighBit, "PhotometricInterpretation": shown}
    path = write(tmp_path, pixels, RescaleSlope=0.5, RescaleIntercept=3, **fields)
    plain = values(path)
    dark_is_low = pixels if shown == "MONOCHROME2" else 2.0**packed.BitsStored - 1 - pixels
    np.testing.assert_array_equal(plain, 0.5 * dark_is_low + 3)
    dataset = pydicom.dcmread(path)
    dataset.file_meta.TransferSyntaxUID = packed.file_meta.TransferSyntaxUID
    dataset.add(packed["PixelData"])
    dataset.save_as(path, enforce_file_format=True)
    np.testing.assert_array_equal(values(path), plain)
    np.testing.assert_array_equal(values(path, frames="mean"), plain)
    dataset.PixelData = dataset.PixelData[:40]
    dataset["PixelData"].is_undefined_length = True
    dataset.save_as(path, enforce_file_format=True)
    with pytest.raises(InputError, match=r"run\.dcm: the DICOM file holds no image that can be decoded"):
        read_stored(path)


def test_a_compression_that_is_not_read_is_named(tmp_path: Path) -> None:
    path = write(tmp_path)
    dataset = pydicom.dcmread(path)
    dataset.compress(RLELossless)
    dataset.file_meta.TransferSyntaxUID = MPEG2MPML
    dataset.save_as(path, enforce_file_format=True)
    with pytest.raises(InputError, match=r"\(compressed as MPEG2 .*not read\)\. Export it anew, uncompressed\.$"):
        read_stored(path)


def test_an_enhanced_image_says_in_its_groups_what_its_values_are(tmp_path: Path) -> None:
    def group(**inner: Dataset) -> Dataset:
        shared = Dataset()
        for name, item in inner.items():
            setattr(shared, name, [item])
        return shared

    pixel, transformation = Dataset(), Dataset()
    pixel.PixelIntensityRelationship, pixel.PixelIntensityRelationshipSign = "LIN", -1
    pixel.ImagerPixelSpacing = [0.2, 0.2]
    transformation.RescaleSlope, transformation.RescaleIntercept, transformation.RescaleType = 2, 10, "US"
    shared = group(FramePixelDataPropertiesSequence=pixel, PixelValueTransformationSequence=transformation)
    read = read_stored(write(tmp_path, NumberOfFrames=1, SharedFunctionalGroupsSequence=[shared]))
    np.testing.assert_array_equal(read.values.numpy(), 2 * (4095 - PIXELS.astype(int)) + 10)
    assert read.intensity == "raw"
    assert read.tags is not None
    assert read.tags.pixel_mm == (0.2, 0.2)
    pixel.PixelIntensityRelationship, pixel.PixelIntensityRelationshipSign = "LOG", 1
    to_linear = lut(0, np.arange(4096, dtype=np.uint16) * 3)
    to_linear.LUTFunction = "TO_LINEAR"
    shared = group(FramePixelDataPropertiesSequence=pixel, PixelIntensityRelationshipLUTSequence=to_linear)
    read = read_stored(write(tmp_path, NumberOfFrames=1, SharedFunctionalGroupsSequence=[shared]))
    np.testing.assert_array_equal(read.values.numpy(), 3 * PIXELS.astype(int))
    assert read.intensity == "raw"


def group(**values: object) -> Dataset:
    item = Dataset()
    for name, value in values.items():
        setattr(item, name, value)
    return item


def test_an_enhanced_run_says_of_each_frame_where_the_arm_stood(tmp_path: Path) -> None:
    frames = [
        group(
            XRayGeometrySequence=[group(DistanceSourceToDetector=1000 + 5 * n)],
            PositionerPositionSequence=[group(PositionerPrimaryAngle=30 * n)],
        )
        for n in (0, 0, 1)
    ]
    path = write(tmp_path, np.stack([PIXELS] * 3), NumberOfFrames=3, PerFrameFunctionalGroupsSequence=frames)
    for number, sdd, source in ((1, 1000, 180), (3, 1005, 210)):
        tags = read_stored(path, (number,)).tags
        assert tags is not None
        assert (tags.sdd_mm, tags.source_deg) == (sdd, source)
    np.testing.assert_array_equal(values(path, frames=(1, 2)), PIXELS)
    for moved in ((1, 3), "mean"):
        with pytest.raises(InputError, match="the C-arm moved between these frames"):
            values(path, frames=moved)


def test_big_endian_and_an_empty_rescale(tmp_path: Path) -> None:
    np.testing.assert_array_equal(values(write(tmp_path, RescaleSlope=None, RescaleIntercept=None)), PIXELS)
    path = write(tmp_path)
    dataset = pydicom.dcmread(path)
    dataset.PixelData = PIXELS.astype(">u2").tobytes()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRBigEndian
    pydicom.dcmwrite(path, dataset, implicit_vr=False, little_endian=False, force_encoding=True)
    np.testing.assert_array_equal(values(path), PIXELS)


def test_pictures_of_a_screen_in_dicom(tmp_path: Path) -> None:
    grey = (PIXELS >> 4).astype(np.uint8)
    eight = {"BitsAllocated": 8, "BitsStored": 8, "HighBit": 7}
    for planar in (0, 1):
        rgb = np.stack([grey] * 3, 0 if planar else -1)
        colours = {"SamplesPerPixel": 3, "PlanarConfiguration": planar, "PhotometricInterpretation": "RGB"}
        found = read_stored(write(tmp_path, grey, PixelData=rgb.tobytes() + b"\0", **colours, **eight))
        np.testing.assert_array_equal(found.values.numpy(), grey)
        assert "is a picture of a screen" in found.remarks[0]
    capture = read_stored(write(tmp_path, grey, SOPClassUID=SecondaryCaptureImageStorage))
    assert "is a picture of a screen" in capture.remarks[0]
    assert read_stored(write(tmp_path, grey)).remarks == ()  # a C-arm's own 8 bits
    with pytest.raises(InputError, match="a colour image"):
        read_stored(write(tmp_path, grey, PhotometricInterpretation="PALETTE COLOR"))


def test_what_the_values_are_is_settled_between_file_and_case(tmp_path: Path) -> None:
    linear = read_stored(write(tmp_path, PixelIntensityRelationship="LIN"))
    silent, shown = read_stored(write(tmp_path)), read_stored(write(tmp_path, PixelIntensityRelationship="DISP"))
    radiograph = read_stored(write(tmp_path, Modality="DX"))
    assert settled(None, linear, "a") == settled("raw", linear, "a") == settled(None, silent, "a") == "raw"
    assert settled("log", silent, "a") == settled("log", shown, "a") == "log"
    with pytest.raises(InputError, match=r"a holds intensities \(raw\) by its PixelIntensityRelationship"):
        settled("log", linear, "a")
    for asked in (shown, radiograph):
        with pytest.raises(InputError, match="Say so in the view"):
            settled(None, asked, "a")


def test_padding_and_shutters_are_no_image(tmp_path: Path) -> None:
    assert read_stored(write(tmp_path)).padding is None
    padded = PIXELS.copy()
    padded[0] = 0
    read = read_stored(write(tmp_path, padded, PixelPaddingValue=0))
    np.testing.assert_array_equal(read.padding, padded == 0)
    round_ = {"ShutterShape": "CIRCULAR", "CenterOfCircularShutter": [3, 4], "RadiusOfCircularShutter": 2}
    assert read_stored(write(tmp_path, **round_)).tags.field == Circle((3.0, 2.0), 2.0)  # type: ignore[union-attr]
    edges = dict(
        zip(("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal"), (2, 6, 1, 4), strict=True)
    )
    square = {"CollimatorShape": "RECTANGULAR"} | {f"Collimator{name}Edge": n for name, n in edges.items()}
    corners = ((1.0, 0.0), (5.0, 0.0), (5.0, 3.0), (1.0, 3.0))
    assert read_stored(write(tmp_path, **square)).tags.field == Polygon(corners)  # type: ignore[union-attr]


@pytest.mark.parametrize("blades", ["Shutter", "Collimator"])
def test_blades_within_a_round_shutter_leave_what_lies_in_both(tmp_path: Path, blades: str) -> None:
    """As arms of an intensifier tell them: the round screen as a display shutter, the blades in a tag of their own."""
    names = ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
    told_by: dict[str, object] = {f"{blades}{name}Edge": n for name, n in zip(names, (3, 7, 1, 4), strict=True)}
    told_by |= {"CenterOfCircularShutter": [3, 4], "RadiusOfCircularShutter": 2}
    told_by["ShutterShape"] = ["RECTANGULAR", "CIRCULAR"] if blades == "Shutter" else "CIRCULAR"
    if blades == "Collimator":
        told_by["CollimatorShape"] = "RECTANGULAR"
    field = read_header(write(tmp_path, **told_by)).field
    assert field is not None
    round_, square = Circle((3.0, 2.0), 2.0), Polygon(((2.0, 0.0), (6.0, 0.0), (6.0, 3.0), (2.0, 3.0)))
    assert torch.equal(field.exposed((5, 7)), round_.exposed((5, 7)) & square.exposed((5, 7)))
    unknown = {f"{blades}{name}Edge": 0 for name in names} | {f"{blades}Shape": "RECTANGULAR"}
    assert read_header(write(tmp_path, **unknown)).field is None


_USUAL = Display()


def told(folder: Path, display: Display = _USUAL, uncertainty: Uncertainty | None = None, **tags: object) -> str:
    read = read_stored(write(folder, **tags)).tags
    assert isinstance(read, Tags)
    return "; ".join(contradictions(read, CAMERA, display, uncertainty))


def test_lengths_of_header_and_case(tmp_path: Path) -> None:
    assert told(tmp_path, DistanceSourceToDetector=1004, ImagerPixelSpacing=[0.2, 0.2]) == ""
    assert "DistanceSourceToDetector is 1100 mm" in told(tmp_path, DistanceSourceToDetector=1100)
    assert told(tmp_path, uncertainty=Uncertainty(sdd_percent=4), DistanceSourceToDetector=1100) == ""
    assert "ImagerPixelSpacing (row, column) is 0.2, 0.4 mm" in told(tmp_path, ImagerPixelSpacing=[0.2, 0.4])
    assert told(tmp_path, PixelSpacing=[0.5, 0.5]) == ""  # in whatever plane
    with pytest.raises(InputError, match=r"run\.dcm: DICOM tag ImagerPixelSpacing: a positive number"):
        read_stored(write(tmp_path, ImagerPixelSpacing=[0.2, -1]))


@pytest.mark.parametrize(
    ("tags", "sides"),
    [
        ({"PositionerPrimaryAngle": 0}, {"posterior"}),  # the detector in front
        ({"PositionerPrimaryAngle": -180}, {"anterior"}),
        ({"PositionerPrimaryAngle": 90}, {"right"}),  # the detector at the patient's left
        ({"PositionerPrimaryAngle": -40}, {"posterior", "left"}),
        ({"ViewPosition": "AP"}, {"anterior"}),
        ({"ViewPosition": "PA"}, {"posterior"}),
        ({"ViewPosition": "LLD"}, {"anterior", "posterior", "left", "right"}),
    ],
)
def test_the_side_of_the_source(tmp_path: Path, tags: dict, sides: set[str]) -> None:
    fits = {side for side in SOURCES if not told(tmp_path, Display(side), **tags)}
    assert fits == sides


def test_the_angle_of_a_spin_is_that_of_its_beginning_and_says_nothing_of_a_frame(tmp_path: Path) -> None:
    run = np.stack([PIXELS, PIXELS[::-1], PIXELS[:, ::-1]])
    spin = {"PositionerMotion": "DYNAMIC", "PositionerPrimaryAngle": -90, "PositionerPrimaryAngleIncrement": 90}
    read = read_stored(
        write(tmp_path, run, NumberOfFrames=3, **spin), (2,)
    ).tags  # from behind, where it began at the left
    assert read is not None
    assert read.source_deg is None
    assert not contradictions(read, CAMERA, Display("posterior"), None)
    still = read_header(write(tmp_path, run, NumberOfFrames=3, **spin | {"PositionerMotion": "STATIC"}))
    assert still.source_deg == 90


@pytest.mark.parametrize(
    ("orientation", "display"),
    [
        (["L", "F"], Display()),
        (["R", "F"], Display(mirrored=True)),
        (["R", "H"], Display(turned_deg=180)),
        (["H", "L"], Display(turned_deg=90)),  # what led right leads down
        (["F", "R"], Display(turned_deg=270)),
        (["F", "L"], Display(mirrored=True, turned_deg=270)),
        (["LP", "FR"], Display("posterior")),
        (["A", "F"], Display("left", mirrored=True)),
        (["P", "F"], Display("right")),
    ],
)
def test_the_orientation_of_the_picture(tmp_path: Path, orientation: list[str], display: Display) -> None:
    assert told(tmp_path, display, PatientOrientation=orientation) == ""
    other = Display(display.source, not display.mirrored, display.turned_deg)
    assert "PatientOrientation" in told(tmp_path, other, PatientOrientation=orientation)


@pytest.mark.parametrize(("rotation", "flip"), [(0, "NO"), (90, "NO"), (180, "YES"), (270, "YES"), (90, "YES")])
def test_a_field_that_is_not_in_the_middle_moves_the_principal_point(tmp_path: Path, rotation: int, flip: str) -> None:
    """The header, against a marked pixel at the middle of a detector that is cut, turned and mirrored."""
    detector = np.zeros((41, 61), np.uint16)
    detector[20, 30] = 4000  # the middle
    field = detector[12:31, 19:40]
    stored = np.rot90(field, -rotation // 90)  # clockwise
    stored = stored[:, ::-1] if flip == "YES" else stored
    path = write(
        tmp_path,
        np.ascontiguousarray(stored),
        ImagerPixelSpacing=[0.3, 0.3],
        DistanceSourceToDetector=900,
        FieldOfViewOrigin=[12, 19],
        FieldOfViewRotation=rotation,
        FieldOfViewHorizontalFlip=flip,
        DetectorElementSpacing=[0.3, 0.3],
        DetectorActiveDimensions=[41 * 0.3, 61 * 0.3],
    )
    row, column = np.argwhere(stored)[0]
    found = carm_settings(path)
    assert found["principal_point_px"] == pytest.approx([column, row])
    assert (found["sdd_mm"], found["pixel_mm"], found["shape"]) == (900, [0.3, 0.3], list(stored.shape))


def test_a_header_with_gaps_tells_no_carm(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"does not say `sdd_mm` \(DistanceSourceToDetector\)"):
        carm_settings(write(tmp_path, ImagerPixelSpacing=[0.2, 0.2]))


def test_a_distance_of_0_is_one_that_is_not_known(tmp_path: Path) -> None:
    assert read_header(write(tmp_path, DistanceSourceToDetector=0)).sdd_mm is None


def test_a_header_that_cannot_be_parsed_is_told_with_its_file(tmp_path: Path) -> None:
    path = write(tmp_path)
    content = path.read_bytes()
    rows = content.index(b"\x28\x00\x10\x00US\x02\x00")  # 2 bytes of (0028,0010); 3 are no number
    path.write_bytes(content[: rows + 6] + b"\x03\x00" + content[rows + 8 : rows + 10] + b"\0" + content[rows + 10 :])
    with pytest.raises(InputError, match="its DICOM header cannot be read"):
        read_header(path)


def test_a_picture_has_no_header_that_tells_the_c_arm(tmp_path: Path) -> None:
    (tmp_path / "view1.tif").write_bytes(b"II*\0")
    with pytest.raises(InputError, match=r"view1\.tif: is no DICOM file, whose header could tell the C-arm"):
        carm_settings(tmp_path / "view1.tif")
    (tmp_path / "view1.gif").write_bytes(b"GIF89a")
    with pytest.raises(InputError, match=r"no known suffix of an image \(\.png, \.tif, .*Save it as 16-bit TIFF"):
        read_stored(tmp_path / "view1.gif")
