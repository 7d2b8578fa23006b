"""Images from files, and every way in which a file can be wrong."""

from pathlib import Path

import cv2
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import tifffile
import torch
from fuzz_faults import full_after
from PIL import Image
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import check_matches, raised, read_image, read_stored, write_image
from femoreg_torch.geometry import load_carm

PIXELS = np.random.default_rng(0).integers(0, 4096, (12, 10), dtype=np.uint16)


def write_dicom(path: Path, pixels: np.ndarray = PIXELS, **fields: object) -> Path:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    settings = {
        "SOPClassUID": meta.MediaStorageSOPClassUID,
        "SOPInstanceUID": "1.2.3",
        "Rows": pixels.shape[-2],
        "Columns": pixels.shape[-1],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16,
        "BitsStored": 12,
        "HighBit": 11,
        "PixelRepresentation": 0,
        "PixelData": pixels.tobytes(),
    } | fields
    for name, value in settings.items():
        setattr(dataset, name, value)
    pydicom.dcmwrite(path, dataset)
    return path


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff", ".TIF"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pictures_as_stored(tmp_path: Path, suffix: str, dtype: type) -> None:
    pixels = (PIXELS // (1 if dtype is np.uint16 else 16)).astype(dtype)
    cv2.imwrite(str(tmp_path / f"view{suffix}"), pixels)
    image = read_image(tmp_path / f"view{suffix}")
    assert image.dtype == torch.float32
    np.testing.assert_array_equal(image.numpy(), pixels)


def test_a_file_of_several_pages_is_not_read_by_its_first(tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "run.tif"), [PIXELS, PIXELS + 1])
    with pytest.raises(InputError, match=r"run\.tif: holds 2 pictures, one was expected"):
        read_image(tmp_path / "run.tif")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_written_images_come_back(tmp_path: Path, suffix: str) -> None:
    pixels = torch.from_numpy(PIXELS * 16)
    write_image(tmp_path / f"view{suffix}", pixels)
    assert torch.equal(read_image(tmp_path / f"view{suffix}"), pixels.float())
    assert [p.name for p in tmp_path.iterdir()] == [f"view{suffix}"]


@pytest.mark.parametrize("name", ["view.nii.gz", "view.mha", "slice.mha", "slice.nii.gz", "view.nrrd"])
def test_itk_formats_of_two_dimensions_or_one_slice(tmp_path: Path, name: str) -> None:
    pixels = PIXELS.astype(np.float32)
    sitk.WriteImage(sitk.GetImageFromArray(pixels[None] if "slice" in name else pixels), str(tmp_path / name))
    np.testing.assert_array_equal(read_image(tmp_path / name).numpy(), pixels)


@pytest.mark.parametrize("name", ["view.dcm", "IM0001"])
def test_dicom(tmp_path: Path, name: str) -> None:
    np.testing.assert_array_equal(read_image(write_dicom(tmp_path / name)).numpy(), PIXELS)


def test_dicom_rescale(tmp_path: Path) -> None:
    path = write_dicom(tmp_path / "view.dcm", RescaleSlope=2, RescaleIntercept=-7)
    np.testing.assert_array_equal(read_image(path).numpy(), PIXELS * 2.0 - 7)


def test_dicom_that_shows_low_values_bright_is_inverted(tmp_path: Path) -> None:
    path = write_dicom(tmp_path / "view.dcm", PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_array_equal(read_image(path).numpy(), 4095.0 - PIXELS)
    signed = (PIXELS.astype(np.int16) - 2048).astype(np.int16)
    path = write_dicom(tmp_path / "signed.dcm", signed, PhotometricInterpretation="MONOCHROME1", PixelRepresentation=1)
    np.testing.assert_array_equal(read_image(path).numpy(), -1.0 - signed)


def damaged(kind: str, folder: Path) -> Path:
    """An image that is wrong in the way of `kind`."""
    path = folder / "view.png"
    floats = PIXELS.astype(np.float32)
    floats[3, 4] = np.nan
    if kind == "text":
        path.write_text("not an image", encoding="utf-8")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "colour":
        cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 255, (12, 10, 3), dtype=np.uint8))
    elif kind == "constant":
        cv2.imwrite(str(path), np.full((12, 10), 77, np.uint8))
    elif kind == "cut":
        cv2.imwrite(str(path), PIXELS)
        path.write_bytes(path.read_bytes()[:30])
    elif kind == "no dicom":
        path = folder / "view.jpeg2"
        path.write_text("not an image", encoding="utf-8")
    elif kind.startswith("nan"):
        path = folder / f"view.{kind.removeprefix('nan ')}"
        sitk.WriteImage(sitk.GetImageFromArray(floats), str(path))
    elif kind == "volume":
        path = folder / "view.mha"
        sitk.WriteImage(sitk.GetImageFromArray(np.stack([PIXELS] * 5)), str(path))
    elif kind == "frames":
        path = write_dicom(folder / "view.dcm", np.stack([PIXELS] * 2), NumberOfFrames=2)
    elif kind == "no pixels":
        path = write_dicom(folder / "view.dcm")
        dataset = pydicom.dcmread(path)
        del dataset.PixelData
        dataset.save_as(path)
    elif kind == "short pixels":
        path = write_dicom(folder / "view.dcm", Rows=50)
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such file"),
        ("text", "cannot be read as a PNG, TIFF or JPEG"),
        ("empty", r"is empty \(0 bytes\)"),
        ("cut", "cannot be read as a PNG, TIFF or JPEG"),
        ("colour", "colour image"),
        ("constant", "every pixel is 77"),
        ("no dicom", "not a DICOM file"),
        ("nan tif", "not finite"),
        ("nan mha", "not finite"),
        ("nan nii", "not finite"),
        ("volume", "one image was expected, found 5 × 12 × 10"),
        ("frames", "several frames"),
        ("no pixels", "no image that can be decoded"),
        ("short pixels", "no image that can be decoded"),
    ],
)
def test_bad_images(tmp_path: Path, kind: str, message: str) -> None:
    path = damaged(kind, tmp_path)
    with pytest.raises(InputError, match=message) as raised:
        read_image(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_image_of_another_shape_than_the_detector() -> None:
    camera = load_carm("cios_fusion").camera
    check_matches(torch.zeros(1536, 1536), camera, "case.yaml, views[1].anatomy: view2.tif")
    with pytest.raises(InputError) as raised:
        check_matches(torch.zeros(1024, 1536), camera, "case.yaml, views[1].anatomy: view2.tif")
    assert str(raised.value).startswith(
        "case.yaml, views[1].anatomy: view2.tif is 1024 × 1536 pixels, but the C-arm has 1536 × 1536."
    )


def test_a_picture_on_a_full_disk_is_told_with_its_name_and_nothing_beside(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Libpng would print a line of its own."""
    noise = torch.randint(0, 60_000, (64, 64), generator=torch.Generator().manual_seed(0)).to(torch.uint16)
    with full_after(1000), pytest.raises(OSError, match="File too large") as raised:
        write_image(tmp_path / "a.png", noise)
    assert raised.value.filename == str(tmp_path / "a.png")
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("image", "name"), [(torch.zeros(3, 4), "a.png"), (torch.zeros(2, 3, 4).to(torch.uint16), "a.png")]
)
def test_only_16_bit_grey_images_are_written(tmp_path: Path, image: torch.Tensor, name: str) -> None:
    with pytest.raises(InputError, match="uint16"):
        write_image(tmp_path / name, image)


def test_an_image_is_not_written_into_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        write_image(tmp_path / "no" / "view.png", torch.from_numpy(PIXELS))


def test_a_tiff_of_8_bits_that_says_that_0_is_white_is_turned_over(tmp_path: Path) -> None:
    pixels = (PIXELS // 16).astype(np.uint8)
    tifffile.imwrite(tmp_path / "view.tif", pixels, photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "view.tif").numpy(), 255 - pixels)


@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.uint32, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_other_tiffs_that_say_that_0_is_white_are_refused(tmp_path: Path, dtype: type, order: str, big: bool) -> None:
    """How bright their white is, they do not say: 12 bits often stand in 16."""
    for kind in ("minisblack", "miniswhite"):
        tifffile.imwrite(tmp_path / f"{kind}.tif", PIXELS.astype(dtype), photometric=kind, byteorder=order, bigtiff=big)
    np.testing.assert_array_equal(read_image(tmp_path / "minisblack.tif").numpy(), PIXELS)
    with pytest.raises(InputError, match=r"miniswhite\.tif: says that 0 is white"):
        read_image(tmp_path / "miniswhite.tif")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize("big", [False, True])
def test_a_tiff_of_16_bits_with_channels_beside_the_grey_one_is_refused(
    tmp_path: Path, order: str, channels: int, big: bool
) -> None:
    """OpenCV gives 12 bits in 16 as values from 0 to 15, or mixes the channels; of 8 bits none are lost."""
    for dtype in (np.uint8, np.uint16):
        grey = PIXELS.astype(dtype)
        pixels = np.stack([grey, *[np.full_like(grey, np.iinfo(dtype).max)] * (channels - 1)], -1)
        extra = ["unassalpha", "unspecified"][: channels - 1]
        tifffile.imwrite(
            tmp_path / f"{dtype.__name__}.tif",
            pixels,
            photometric="minisblack",
            extrasamples=extra,
            byteorder=order,
            bigtiff=big,
        )
    np.testing.assert_array_equal(read_image(tmp_path / "uint8.tif").numpy(), PIXELS.astype(np.uint8))
    with pytest.raises(InputError, match=r"uint16\.tif: has grey values of 16 bits and an alpha or another"):
        read_image(tmp_path / "uint16.tif")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_that_is_to_be_shown_turned_is_refused(tmp_path: Path, suffix: str) -> None:
    picture = Image.fromarray((PIXELS // 16).astype(np.uint8))
    exif = Image.Exif()
    for orientation in (1, 6):
        exif[274] = orientation
        picture.save(tmp_path / f"view{orientation}{suffix}", exif=exif)
    assert read_image(tmp_path / f"view1{suffix}").shape == PIXELS.shape
    with pytest.raises(InputError, match="is to be shown turned or mirrored"):
        read_image(tmp_path / f"view6{suffix}")


def test_an_offset_of_all_values_is_told() -> None:
    image = torch.linspace(0.02, 1, 64 * 64).reshape(64, 64) * 4000
    assert raised(image) is None
    assert "has values of 32848 to 36768: was something added" in (raised(image + 32768) or "")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_of_8_bits_are_told(tmp_path: Path, suffix: str) -> None:
    cv2.imwrite(str(tmp_path / f"view{suffix}"), (PIXELS // 16).astype(np.uint8))
    assert any("picture of a screen" in remark for remark in read_stored(tmp_path / f"view{suffix}").remarks)
    write_image(tmp_path / f"deep{suffix}", torch.from_numpy(PIXELS).to(torch.uint16))
    assert not read_stored(tmp_path / f"deep{suffix}").remarks
