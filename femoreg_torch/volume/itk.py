"""Images of the formats that SimpleITK reads."""

from pathlib import Path

import SimpleITK as sitk

from femoreg_torch.errors import InputError
from femoreg_torch.volume.nifti import check_nifti


def read_itk(path: Path) -> sitk.Image:
    """The image of a NIfTI, NRRD or MHA file, or of the one DICOM series in a folder, as it is stored.

    Raises `InputError` for what cannot be read, is cut off (NIfTI), or holds complex values or, in a NIfTI file, values
    that are not finite.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    sitk.ProcessObject.SetGlobalWarningDisplay(False)  # the reason of a failure comes with the exception
    check_nifti(path)
    try:
        image = _read_dicom_series(path) if path.is_dir() else sitk.ReadImage(str(path))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("sitk::ERROR: ")
        raise InputError(
            f"{path}: cannot be read as NIfTI-1, NRRD, MHA or DICOM series ({reason}). Save it in one of these formats."
        ) from error
    if "complex" in image.GetPixelIDTypeAsString():
        raise InputError(f"{path}: holds complex values, but real ones were expected. Export their real part.")
    return image


def _read_dicom_series(folder: Path) -> sitk.Image:
    reader = sitk.ImageSeriesReader()
    series = {uid: reader.GetGDCMSeriesFileNames(str(folder), uid) for uid in reader.GetGDCMSeriesIDs(str(folder))}
    if not series:
        raise InputError(
            f"{folder}: holds no DICOM series. Give the folder of the slices, or a NIfTI, NRRD or MHA file."
        )
    if len(series) > 1:
        sizes = ", ".join(f"{len(names)} slices" for names in series.values())
        raise InputError(
            f"{folder}: holds {len(series)} DICOM series ({sizes}), one was expected. Move one to its own folder."
        )
    reader.SetFileNames(next(iter(series.values())))
    return reader.Execute()
