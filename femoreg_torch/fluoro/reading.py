"""Reading and writing of fluoroscopic images."""

import struct
import warnings
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import SimpleITK as sitk
import torch
from PIL import ExifTags, Image
from torch import Tensor

from femoreg_torch.arrays import MOST_PIXELS, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.fluoro.dicom import SCREEN, DicomImage, Frames, read_dicom, read_header
from femoreg_torch.fluoro.png import chunks_are_there
from femoreg_torch.fluoro.suffixes import ITK_SUFFIXES, PICTURE_SUFFIXES, SCREEN_SUFFIXES
from femoreg_torch.fluoro.tags import Tags
from femoreg_torch.geometry import Camera
from femoreg_torch.paths import check_readable
from femoreg_torch.pictures import write_picture
from femoreg_torch.text import read_bytes
from femoreg_torch.volume.dicom.headers import is_dicom
from femoreg_torch.volume.itk import read_itk

_PAGED_SUFFIXES = (".tif", ".tiff")
_IN_COLOUR = "is a grey picture stored in colour, as pictures of a screen are: is its curve that of the detector?"
LOOKS_LOG = "looks like logarithms already"  # what a file of fractions asks the case about
_LOG_RANGE = (2.0, 20.0)  # of the greatest attenuation in an image: 45 cm of water at 60 keV are 9
_MOST_PICTURE_BYTES = 2**28  # what the most pixels have as floats
_BITS_PER_SAMPLE, _PHOTOMETRIC_INTERPRETATION, _SAMPLES_PER_PIXEL = 258, 262, 277  # tags of TIFF
_TIFF, _BIG_TIFF, _MOST_TAGS = 42, 43, 2**16
_GREY_STEPS = 12  # by which the colours of a grey JPEG may differ


@dataclass(frozen=True, eq=False)
class StoredImage:
    """An image as it is stored, and what its file says of it."""

    values: Tensor  # (H, W) float32
    intensity: Literal["raw", "log"] | None = None  # what the file says the values are
    tags: Tags | None = None  # of a DICOM file
    padding: Tensor | None = None  # (H, W) bool: pixels that hold no image
    remarks: tuple[str, ...] = ()  # for the user, after the name of the file
    asks: str | None = None  # why the case has to say what the values are
    bone_is_dark: bool = False  # whether the file says so of the values, and not what they are

    def values_as(self, intensity: Literal["raw", "log"]) -> Tensor:
        """The values (H, W), as the case says what they are: bone dark in intensities, bright in logarithms.

        Where the header tells which way they run, they run so, however a viewer shows them.
        """
        return self.values.max() - self.values if intensity == "log" and self.bone_is_dark else self.values


def _read_picture(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    content = read_bytes(path, _MOST_PICTURE_BYTES)
    image, pages = None, 1
    if content and chunks_are_there(content):
        with suppress(cv2.error, MemoryError), quiet():  # of more pixels than OpenCV was told to allow
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
            if image is not None and path.suffix.lower() in _PAGED_SUFFIXES:
                pages = cv2.imcount(str(path))
    if pages > 1:
        raise InputError(f"{path}: holds {pages} pictures, one was expected. Save each as a file of its own.")
    if image is None:
        raise InputError(
            f"{path}: cannot be read as a PNG, TIFF or JPEG image of at most {MOST_PIXELS} pixels; the file is damaged "
            "or something else."
        )
    if path.suffix.lower() not in _PAGED_SUFFIXES and _is_shown_turned(content):  # of TIFF files OpenCV turns them
        raise InputError(
            f"{path}: says that it is to be shown turned or mirrored (EXIF). Save it as it is to be shown."
        )
    if path.suffix.lower() in _PAGED_SUFFIXES:
        _check_tiff(path, content, image)
    screen = path.suffix.lower() in SCREEN_SUFFIXES or image.dtype == np.uint8
    if image.ndim == 3 and image.shape[-1] in (3, 4):
        colours = image[..., :3].astype(np.int64)
        if np.ptp(colours, axis=-1).max() <= (_GREY_STEPS if path.suffix.lower() in SCREEN_SUFFIXES else 0):
            return image[..., 1], (SCREEN if screen else _IN_COLOUR,)
    return image, (SCREEN,) if screen else ()


def _check_tiff(path: Path, content: bytes, image: np.ndarray) -> None:
    """Raises `InputError` for a TIFF file whose values OpenCV gives otherwise than they are meant.

    It turns those of 8 bits over alone where 0 is white. Of grey values of more bits beside other channels it gives the
    upper 8 bits, or mixes the channels.
    """
    bits, channels = (_tiff_tag(content, tag) or 1 for tag in (_BITS_PER_SAMPLE, _SAMPLES_PER_PIXEL))
    if image.ndim == 2 and channels > 1 and bits > 8:
        raise InputError(
            f"{path}: has grey values of {bits} bits and an alpha or another channel beside them, of which not all "
            "bits can be read. Save it without that channel."
        )
    if image.dtype != np.uint8 and _tiff_tag(content, _PHOTOMETRIC_INTERPRETATION) == 0:
        raise InputError(f"{path}: says that 0 is white (WhiteIsZero). Save it with 0 as black (BlackIsZero).")


def _tiff_tag(tiff: bytes, wanted: int) -> int | None:
    """The first value of a tag of short numbers, or None.

    The first directory is looked through by itself, as Pillow does not open all kinds of numbers (TIFF 6.0, section 2).
    BigTIFF is the same with places and counts of eight bytes.
    """
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    with suppress(struct.error):
        if order is None:
            return None
        (version,) = struct.unpack_from(f"{order}H", tiff, 2)
        if version not in (_TIFF, _BIG_TIFF):
            return None
        offset, counter, first, each = ("I", "H", 4, 12) if version == _TIFF else ("Q", "Q", 8, 20)
        (place,) = struct.unpack_from(f"{order}{offset}", tiff, first)
        (entries,) = struct.unpack_from(f"{order}{counter}", tiff, place)
        start = place + struct.calcsize(counter)
        for entry in range(start, start + each * min(entries, _MOST_TAGS), each):
            tag, _, count = struct.unpack_from(f"{order}HH{offset}", tiff, entry)
            if tag == wanted:
                value = entry + 4 + struct.calcsize(offset)
                if 2 * count > struct.calcsize(offset):  # more than the entry has room for: they stand elsewhere
                    (value,) = struct.unpack_from(f"{order}{offset}", tiff, value)
                return int(struct.unpack_from(f"{order}H", tiff, value)[0])
    return None


def _is_shown_turned(picture: bytes) -> bool:
    """Whether a PNG or JPEG file says by its EXIF orientation that viewers are to turn it."""
    with warnings.catch_warnings(), suppress(OSError, SyntaxError, ValueError):
        warnings.simplefilter("ignore")  # of damaged EXIF data
        with Image.open(BytesIO(picture)) as opened:
            return opened.getexif().get(ExifTags.Base.Orientation, 1) != 1
    return False


def _read_itk(path: Path) -> np.ndarray:
    array = sitk.GetArrayFromImage(read_itk(path))
    return array[0] if array.ndim == 3 and array.shape[0] == 1 else array


def read_stored(path: Path, frames: Frames | None = None) -> StoredImage:
    """A fluoroscopic image and what its file says of it.

    PNG, TIFF and JPEG, NIfTI, MHA or NRRD of one slice, and anything else as DICOM. Values are as stored; those of
    DICOM files after rescaling, with dark bone where the header says or implies that they are intensities, and as
    attenuation (bone bright) where it says that they are logarithms. `frames` of a cine run are averaged. Raises
    `InputError` for a missing or unreadable file, a colour image, a run without `frames`, values that are not finite,
    and an image of constant value.
    """
    path = Path(path)
    check_readable(path)
    name = path.name.lower()
    dicom: DicomImage | None = None
    remarks: tuple[str, ...] = ()
    if name.endswith(PICTURE_SUFFIXES + SCREEN_SUFFIXES):
        array, remarks = _read_picture(path)
    elif name.endswith(ITK_SUFFIXES):
        array = _read_itk(path)
    else:
        dicom = read_dicom(path, frames)
        array, remarks = dicom.values, dicom.remarks
    if frames is not None and dicom is None:
        raise InputError(f"{path}: `frames` are for DICOM files. Leave them out.")
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
    if dicom is None:
        looks_log = lowest > -1 and _LOG_RANGE[0] < highest < _LOG_RANGE[1] and bool((image != image.round()).any())
        return StoredImage(image, remarks=remarks, asks=LOOKS_LOG if looks_log else None)
    padding = None if dicom.padding is None else torch.from_numpy(dicom.padding)
    return StoredImage(image, dicom.intensity, dicom.tags, padding, remarks, dicom.asks, dicom.bone_is_dark)


def may_be_image(path: Path) -> bool:
    """Whether a file of a folder is meant as an image: by its suffix, or as a DICOM file that holds pixels.

    Exports hold others beside them: DICOMDIR, reports, presentation states, a viewer.
    """
    if path.name.lower().endswith(PICTURE_SUFFIXES + SCREEN_SUFFIXES + ITK_SUFFIXES):
        return True
    return is_dicom(path) and read_header(path).shape is not None


def read_image(path: Path, frames: Frames | None = None) -> Tensor:
    """The values (H, W), float32, of a fluoroscopic image; see `read_stored`."""
    return read_stored(path, frames).values


def settled_intensity(said: Literal["raw", "log"] | None, image: StoredImage, where: str) -> Literal["raw", "log"]:
    """What the values of an image are, by its file and by what a case says.

    Raises `InputError` that starts with `where` if the two contradict each other, or if neither says it and it cannot
    be taken for granted.
    """
    if said is not None and image.intensity is not None and said != image.intensity:
        words = {"raw": "intensities (raw)", "log": "logarithms (log)"}
        raise InputError(
            f"{where} holds {words[image.intensity]} by its PixelIntensityRelationship, but the case says "
            f"`intensity: {said}`. Correct it, or leave it out."
        )
    if said is None and image.intensity is None and image.asks is not None:
        raise InputError(
            f"{where} {image.asks}. Say so in the view: `intensity: raw` (bone dark) or `log` (bone bright)."
        )
    return said or image.intensity or "raw"


def write_image(path: Path, image: Tensor) -> None:
    """Write a 16-bit grey image (H, W), dtype uint16, as TIFF or PNG by the suffix of `path`.

    Raises `InputError` for another shape, dtype or suffix.
    """
    path = Path(path)
    if image.dtype != torch.uint16 or image.ndim != 2 or path.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputError(f"{path}: a (H, W) uint16 image and a name in {', '.join(PICTURE_SUFFIXES)} were expected.")
    with temporary_file(path) as part:
        write_picture(part, image.numpy())


def check_matches(image: Tensor, camera: Camera, where: str) -> None:
    """Raises `InputError` that starts with `where` if the image (H, W) has not the camera's shape."""
    if tuple(image.shape) != camera.shape:
        found, expected = " × ".join(str(n) for n in image.shape), " × ".join(str(n) for n in camera.shape)
        raise InputError(
            f"{where} is {found} pixels, but the C-arm has {expected}. Export the image uncropped, or give this "
            "C-arm's own shape under `carm:`."
        )
