"""Reading and writing of fluoroscopic images."""

from pathlib import Path

import cv2
import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.arrays import MOST_PIXELS, check_pixels, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera
from femoreg_torch.text import read_bytes
from femoreg_torch.volume.itk import read_itk

_ITK_SUFFIXES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
_PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
_MOST_PICTURE_BYTES = 2**28  # what the most pixels have as floats


def _read_picture(path: Path) -> np.ndarray:
    content = np.frombuffer(read_bytes(path, _MOST_PICTURE_BYTES), np.uint8)
    try:
        with quiet():
            image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except (cv2.error, MemoryError):  # what OpenCV does with more pixels than it was told to allow
        image = None
    if image is None:
        raise InputError(
            f"{path}: cannot be read as a PNG or TIFF image of at most {MOST_PIXELS} pixels; the file is damaged or "
            "something else."
        )
    return image


def _read_itk(path: Path) -> np.ndarray:
    array = sitk.GetArrayFromImage(read_itk(path))
    return array[0] if array.ndim == 3 and array.shape[0] == 1 else array


def _read_dicom(path: Path) -> np.ndarray:
    import pydicom  # a fifth of a second, and most images are of other kinds
    from pydicom.errors import InvalidDicomError
    from pydicom.pixels import apply_rescale

    try:
        with quiet():
            dataset = pydicom.dcmread(path)
            frames = int(dataset.get("NumberOfFrames") or 1)
            if frames > 1:
                raise InputError(f"{path}: holds {frames} frames, one was expected. Export the frame to be registered.")
            check_pixels(path, int(dataset.Rows), int(dataset.Columns))
            pixels = dataset.pixel_array
            if dataset.PhotometricInterpretation == "MONOCHROME1":  # low values are shown bright
                lowest = -(2 ** (dataset.BitsStored - 1)) if dataset.PixelRepresentation else 0
                pixels = 2 * lowest + 2**dataset.BitsStored - 1 - pixels.astype(np.int64)
            return apply_rescale(pixels, dataset)
    except InvalidDicomError as error:
        raise InputError(
            f"{path}: not a DICOM file, and its name does not end in {', '.join(_PICTURE_SUFFIXES + _ITK_SUFFIXES)}."
        ) from error
    except InputError:
        raise
    except Exception as error:  # pydicom's readers and decoders raise whatever their parsing runs into
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: the DICOM file holds no image that can be decoded ({reason}).") from error


def read_image(path: Path) -> Tensor:
    """A fluoroscopic image (H, W), float32, with the values as stored.

    PNG and TIFF of 8 or 16 bits, NIfTI, MHA or NRRD of one slice, and anything else as a single DICOM frame (rescale
    applied, MONOCHROME1 inverted so that dark stays dark). Raises `InputError` for a missing or unreadable file, a
    colour or multi-frame image, values that are not finite, and an image of constant value.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    name = path.name.lower()
    if name.endswith(_PICTURE_SUFFIXES):
        array = _read_picture(path)
    elif name.endswith(_ITK_SUFFIXES):
        array = _read_itk(path)
    else:
        array = _read_dicom(path)
    if array.ndim == 3 and array.shape[-1] in (3, 4):
        raise InputError(f"{path}: a colour image, but fluoroscopy has one value per pixel. Export it as greyscale.")
    if array.dtype.kind not in "biuf":
        raise InputError(f"{path}: holds {array.dtype} values, but real numbers were expected. Export the image anew.")
    if array.ndim != 2 or 0 in array.shape:
        raise InputError(f"{path}: one image was expected, found {' × '.join(str(n) for n in array.shape)} values.")
    image = torch.from_numpy(array.astype(np.float32))
    lowest, highest = (v.item() for v in image.aminmax())
    if not np.isfinite([lowest, highest]).all():
        raise InputError(f"{path}: holds pixels that are not finite (NaN or infinite). Export the image anew.")
    if lowest == highest:
        raise InputError(f"{path}: every pixel is {lowest:g}, there is nothing to be seen. Choose another image.")
    return image


def write_image(path: Path, image: Tensor) -> None:
    """Write a 16-bit grey image (H, W), dtype uint16, as TIFF or PNG by the suffix of `path`."""
    path = Path(path)
    if image.dtype != torch.uint16 or image.ndim != 2 or path.suffix.lower() not in _PICTURE_SUFFIXES:
        raise InputError(f"{path}: a (H, W) uint16 image and a name in {', '.join(_PICTURE_SUFFIXES)} were expected.")
    with temporary_file(path) as part:
        with quiet():
            written = cv2.imwrite(str(part), image.numpy())
        if not written:
            raise OSError(f"{path}: the image could not be written.")


def check_matches(image: Tensor, camera: Camera, where: str) -> None:
    """Raises `InputError` that starts with `where` if the image (H, W) has not the camera's shape."""
    if tuple(image.shape) != camera.shape:
        found, expected = " × ".join(str(n) for n in image.shape), " × ".join(str(n) for n in camera.shape)
        raise InputError(
            f"{where} is {found} pixels, but the C-arm has {expected}. Export the image uncropped, or give this "
            "C-arm's own shape under `carm:`."
        )
