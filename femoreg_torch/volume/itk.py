"""Images of the formats that SimpleITK reads."""

from pathlib import Path

import SimpleITK as sitk

from femoreg_torch.errors import InputError
from femoreg_torch.volume.nifti import check_nifti


def read_itk(path: Path) -> sitk.Image:
    """The image of a NIfTI, NRRD or MHA file, as it is stored.

    Raises `InputError` for what cannot be read, is cut off (NIfTI), or holds complex values or, in a NIfTI file, values
    that are not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    sitk.ProcessObject.SetGlobalWarningDisplay(False)  # the reason of a failure comes with the exception
    check_nifti(path)
    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("sitk::ERROR: ")
        raise InputError(
            f"{path}: cannot be read as NIfTI-1, NRRD, MHA or DICOM series ({reason}). Save it in one of these formats."
        ) from error
    if "complex" in image.GetPixelIDTypeAsString():
        raise InputError(f"{path}: holds complex values, but real ones were expected. Export their real part.")
    return image
