"""Reading and writing of volumes. Whatever a file's index order, volumes inside run along +L, +P, +S."""

from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.nifti import holds_non_finite

_FAT_HU, _BONE_HU = -50, 200  # every CT of a hip holds something below the first and something above the second


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


def _read(path: Path) -> sitk.Image:
    """The image with its index axes turned to run closest to +L, +P, +S. Raises `InputError`."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder.")
    sitk.ProcessObject.SetGlobalWarningDisplay(False)  # the reason of a failure comes with the exception
    try:
        image = _read_dicom_series(path) if path.is_dir() else sitk.ReadImage(str(path))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("sitk::ERROR: ")
        raise InputError(f"{path}: cannot be read as NIfTI, NRRD, MHA or DICOM series ({reason}).") from error
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1 or min(image.GetSize()) < 2:
        size = " × ".join(str(n) for n in image.GetSize())
        raise InputError(
            f"{path}: a 3-D volume of one channel was expected, found {size} voxels of "
            f"{image.GetNumberOfComponentsPerPixel()} channel(s)."
        )
    if np.linalg.det(np.reshape(image.GetDirection(), (3, 3))) < 0:
        raise InputError(
            f"{path}: the direction matrix is mirrored (left-handed, determinant −1), so left and right cannot be told "
            "apart for sure. Export the volume anew with right-handed axes."
        )
    return sitk.DICOMOrient(image, "LPS")


def _lps_from_index(image: sitk.Image) -> Tensor:
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return torch.from_numpy(affine)


def read_volume(path: Path) -> Volume:
    """Any volume as float32 (Z, Y, X) on its own grid, index axes closest to +L, +P, +S, exact affine (also oblique).

    `path` is a NIfTI, NRRD or MHA file or the folder of one DICOM series. Raises `InputError` for what cannot be read,
    is not 3-D, is mirrored, or holds values that are not finite.
    """
    image = _read(path)
    data = torch.from_numpy(sitk.GetArrayViewFromImage(image).astype(np.float32))
    if not torch.isfinite(data).all() or holds_non_finite(Path(path)):
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite). Repair or export it anew.")
    return Volume(data, _lps_from_index(image))


def read_ct(path: Path) -> Volume:
    """A CT in HU, as `read_volume` reads it. Raises `InputError` for what that refuses and for what is not in HU."""
    volume = read_volume(path)
    lowest, highest = (v.item() for v in volume.data.aminmax())
    if lowest == highest:
        raise InputError(f"{path}: every voxel is {lowest:g}; a CT in HU was expected.")
    if lowest > _FAT_HU or highest < _BONE_HU:
        raise InputError(
            f"{path}: values run from {lowest:g} to {highest:g}, but a CT in HU has air or fat (below {_FAT_HU}) and "
            f"bone (above {_BONE_HU}). Export it in Hounsfield units (rescale applied, no window, no attenuation)."
        )
    return volume


def read_labels(path: Path, like: Volume) -> Volume:
    """A label map (uint8) that lies on the grid of `like`. Raises `InputError` if it does not, or is no label map."""
    image = _read(path)
    data = sitk.GetArrayViewFromImage(image)
    affine = _lps_from_index(image)
    if data.shape != tuple(like.data.shape):
        found, expected = (" × ".join(str(n) for n in reversed(shape)) for shape in (data.shape, like.data.shape))
        raise InputError(
            f"{path}: the label map has {found} voxels, but the CT has {expected}. Resample it to the CT's grid."
        )
    corners = torch.cartesian_prod(*(torch.tensor([0.0, n - 1], dtype=torch.float64) for n in reversed(data.shape)))
    shift = affine - like.lps_from_index
    apart = (corners @ shift[:3, :3].T + shift[:3, 3]).norm(dim=1).max().item()
    if apart > 0.05 * min(like.spacing_mm):
        raise InputError(
            f"{path}: the label map lies on another grid than the CT (its corners are up to {apart:.3g} mm away). "
            "Resample it to the CT's grid."
        )
    if data.min() < 0 or data.max() > 255 or (data.dtype.kind == "f" and not (data == np.round(data)).all()):
        raise InputError(f"{path}: whole numbers from 0 to 255 were expected, found {data.min():g} to {data.max():g}.")
    return Volume(torch.from_numpy(data.astype(np.uint8)), like.lps_from_index)


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume; the suffix chooses the format (.nii.gz, .nrrd, .mha). HU (float) are stored as whole numbers."""
    data = volume.data.numpy()
    if data.dtype.kind == "f":
        data = np.clip(np.rint(data), -32768, 32767).astype(np.int16)
    image = sitk.GetImageFromArray(data)
    spacing = np.array(volume.spacing_mm)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((volume.lps_from_index[:3, :3].numpy() / spacing).ravel().tolist())
    image.SetOrigin(volume.lps_from_index[:3, 3].tolist())
    with temporary_file(Path(path)) as part:
        sitk.WriteImage(image, str(part), useCompression=True)
