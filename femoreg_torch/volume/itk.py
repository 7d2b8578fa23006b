"""Images of the formats that SimpleITK reads."""

from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from femoreg_torch.arrays import check_claim, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.paths import check_readable
from femoreg_torch.volume.nifti import NIFTI_SUFFIXES, check_nifti
from femoreg_torch.volume.text_headers import META_SUFFIXES, NRRD_SUFFIXES, check_text_header

DETACHED = (".mhd", ".nhdr", ".hdr", ".img")  # headers, or values, alone
_READERS = {"NiftiImageIO": NIFTI_SUFFIXES, "MetaImageIO": META_SUFFIXES, "NrrdImageIO": NRRD_SUFFIXES}


def read_itk(path: Path) -> sitk.Image:
    """The image of a NIfTI, NRRD or MHA file, as it is stored.

    Raises `InputError` for what cannot be read, is cut off or damaged, claims more voxels than it can hold or than can
    be worked with, lies nowhere (an origin of NaN), or holds complex values or, in a NIfTI file, values that are not
    finite.
    """
    check_readable(path)
    check_nifti(path)
    check_text_header(path)
    try:
        with quiet():
            image = _read_file(path)
    except (RuntimeError, MemoryError, UnicodeDecodeError, OverflowError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1].removeprefix("sitk::ERROR: ")
        if "orthonormal" in str(error):
            raise InputError(
                f"{path}: its axes are not at right angles. Resample it onto a grid whose axes are."
            ) from error
        raise InputError(
            f"{path}: cannot be read as NIfTI-1, NRRD, MHA or DICOM series ({reason[:200]}). Save it in one of these "
            "formats."
        ) from error
    if "complex" in image.GetPixelIDTypeAsString():
        raise InputError(f"{path}: holds complex values, but real ones were expected. Export their real part.")
    place = np.array([*image.GetOrigin(), *image.GetDirection(), *image.GetSpacing()])
    if not np.isfinite(place).all() or min(image.GetSpacing()) <= 0:
        raise InputError(f"{path}: origin, axes and spacing are not all finite numbers. Export it anew.")
    return image


def _read_file(path: Path) -> sitk.Image:
    reader = sitk.ImageFileReader()
    reader.SetImageIO(_reader_of(path))
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    detached = path.name.lower().endswith(DETACHED)
    check_claim(path, reader.GetSize(), reader.GetNumberOfComponents(), None if detached else path.stat().st_size)
    return reader.Execute()


def _reader_of(path: Path) -> str:
    """ITK's reader of a file by its name: of all that ITK knows, these alone are meant."""
    for reader, suffixes in _READERS.items():
        if path.name.lower().endswith(suffixes):
            return reader
    raise InputError(
        f"{path}: a name that ends in {', '.join(s for suffixes in _READERS.values() for s in suffixes)} was expected, "
        "or a DICOM series. Save it in one of these formats."
    )


def image_of(array: NDArray[Any], lps_from_index: NDArray[np.float64]) -> sitk.Image:
    """A volume of highdicom, whose `array` is indexed as the columns of its affine are, as an image of SimpleITK."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    spacing = np.linalg.norm(lps_from_index[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps_from_index[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps_from_index[:3, 3].tolist())
    return image
