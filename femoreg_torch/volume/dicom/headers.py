"""What the headers of DICOM files say, one by one."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.arrays import opened
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.volume.patient import compared_text

_TAGS = (
    "SOPInstanceUID", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription", "Modality", "ImageType", "Rows",
    "Columns", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "NumberOfFrames", "AcquisitionNumber",
    "RescaleSlope", "RescaleIntercept", "PhotometricInterpretation", "BitsStored", "HighBit", "PatientID",
    "PatientName", "StudyInstanceUID", "FrameOfReferenceUID", "SliceThickness", "SpacingBetweenSlices",
)  # fmt: skip
_DEFLATED = "1.2.840.10008.1.2.1.99"  # transfer syntax
_KINDS_OF_PIXELS = (b"OB", b"OW", b"OF", b"OD", b"UN")  # value representations of their element
_UNDEFINED = 0xFFFFFFFF  # length of compressed pixels
_NOT_DICOM = {".gz", ".nii", ".nrrd", ".mha", ".mhd", ".json", ".txt", ".png", ".jpg", ".tif", ".tiff", ".zip", ".stl"}


@dataclass(frozen=True)
class Slice:
    """What the header of one DICOM file says."""

    path: Path
    header: Any  # pydicom.Dataset with some of `_TAGS`
    holds_pixels: bool  # as many bytes of them as it claims

    @property
    def is_scout(self) -> bool:
        """Whether it is a localiser, by ImageType (DICOM PS3.3, C.8.2.1)."""
        return "LOCALIZER" in [str(word).upper() for word in self.header.get("ImageType") or []]

    def numbers(self, name: str, count: int) -> NDArray[np.float64] | None:
        """The `count` numbers of a tag, (count,); None where it is missing or holds something else."""
        value = self.header.get(name)
        try:
            numbers = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            return None
        return numbers if numbers.shape == (count,) and np.isfinite(numbers).all() else None

    def number(self, name: str) -> float | None:
        """The finite number of a tag, or None where it is missing or holds something else."""
        try:
            value = float(self.header.get(name))
        except (TypeError, ValueError):
            return None
        return value if np.isfinite(value) else None

    def words(self, name: str) -> str:
        """The text of a tag as it is compared; empty where it is missing."""
        return compared_text(self.header, name)

    def whole(self, name: str, otherwise: int) -> int:
        """The whole number of a tag."""
        try:
            return int(self.header.get(name) or otherwise)
        except (TypeError, ValueError):
            return otherwise


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM: by its preamble, or, without one, by a first element of the group 0002 or 0008."""
    if not path.is_file() or path.suffix.lower() in _NOT_DICOM:
        return False
    with opened(path) as file:
        head = file.read(132)
    bare = len(head) == 132 and head[:2] in (b"\x02\x00", b"\x08\x00") and head[3:4] == b"\x00"
    return head[128:] == b"DICM" or bare


def headers_in(folder: Path) -> Iterator[Slice]:
    for path in sorted(folder.rglob("*")):
        if path.name.upper() != "DICOMDIR" and is_dicom(path):
            yield slice_of(path)


@contextmanager
def damaged_header(path: Path) -> Iterator[None]:
    """Whatever pydicom's reading of a header runs into is an `InputError` that names the file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # pydicom's parsing raises whatever the bytes lead it to
        raise InputError(
            f"{path}: its DICOM header cannot be read ({shortened(error)}). Export it anew, or take the file away."
        ) from error


def slice_of(path: Path) -> Slice:
    """Some tags of a DICOM file. Raises `InputError`."""
    import pydicom  # a fifth of a second, and most CTs are of other kinds

    with damaged_header(path), path.open("rb") as file:
        header = pydicom.dcmread(file, stop_before_pixels=True, force=True, specific_tags=list(_TAGS))
        for tag in header.keys():  # noqa: SIM118  # a value is parsed when it is first asked for
            header[tag]
        return Slice(path, header, _holds_pixels(file, header, path.stat().st_size))


def _holds_pixels(file: BinaryIO, header: Any, size: int) -> bool:
    """Whether the bytes that the element of the pixels claims are there; the file, of that size, was read up to it.

    GDCM believes a claim, and takes gigabytes of memory and half a minute for a broken file of some hundred bytes.
    Layout of an element: DICOM PS3.5, chapter 7.1.
    """
    if str(getattr(header.file_meta, "TransferSyntaxUID", "")) == _DEFLATED:
        return True  # its elements lie compressed in the file
    implicit, little = header.original_encoding
    element = file.read(12)
    if len(element) < 12 or not (implicit or element[4:6] in _KINDS_OF_PIXELS):
        return False
    start = file.tell() - (4 if implicit else 0)
    length = int.from_bytes(element[4:8] if implicit else element[8:], "little" if little else "big")
    return length == _UNDEFINED or 0 < length <= size - start
