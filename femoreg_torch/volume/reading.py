"""Reading and writing of volumes. Whatever the index order of a file, index axes inside run along +L, +P, +S."""

from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.anatomy.tables import LARGEST_ID
from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry.rigid import FARTHEST_MM
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.itk import read_itk

_FINEST_MM, _COARSEST_MM = 0.01, 50.0  # voxels: of a micro-CT, and more than those of any clinical scan
_FAT_HU, _BONE_HU = -50, 200  # every CT of a hip holds something below the first and something above the second


def _read(path: Path) -> sitk.Image:
    """The volume with its index axes turned to run closest to +L, +P, +S. Raises `InputError`."""
    image = read_itk(path)
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1 or min(image.GetSize()) < 2:
        size = " × ".join(str(n) for n in image.GetSize())
        raise InputError(
            f"{path}: a 3-D volume of one channel was expected, found {size} voxels of "
            f"{image.GetNumberOfComponentsPerPixel()} channel(s)."
        )
    spacing = image.GetSpacing()
    if not (min(spacing) >= _FINEST_MM and max(spacing) <= _COARSEST_MM):
        told = " × ".join(f"{s:.3g}" for s in spacing)
        raise InputError(
            f"{path}: voxels of {told} mm were found, {_FINEST_MM:g} to {_COARSEST_MM:g} mm expected. Is it in mm?"
        )
    if max(map(abs, image.GetOrigin())) > FARTHEST_MM:
        raise InputError(f"{path}: its origin lies {max(map(abs, image.GetOrigin())):.3g} mm away. Export it anew.")
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
    image = _read(Path(path))
    stored = sitk.GetArrayViewFromImage(image)
    data = torch.from_numpy(stored.astype(np.float32))
    if stored.dtype.kind == "f" and not torch.isfinite(data).all():
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


def read_label_map(path: Path) -> Volume:
    """A label map by itself, on its own grid, oriented as by `read_volume`.

    Labels are uint8 where they fit, else int32. Raises `InputError` for what `read_volume` refuses, and for values that
    are no whole numbers from 0 to 65535.
    """
    image = _read(Path(path))
    data = sitk.GetArrayViewFromImage(image)
    whole = data.dtype.kind in "iu" or (data == np.floor(data)).all()
    if not (data.min() >= 0 and data.max() <= LARGEST_ID and whole):
        raise InputError(
            f"{path}: a label map of whole numbers from 0 to {LARGEST_ID} was expected, found {data.min():g} to "
            f"{data.max():g}. Export the segmentation as a label map."
        )
    labels = data.astype(np.uint8 if data.max() <= 255 else np.int32)
    return Volume(torch.from_numpy(labels), _lps_from_index(image))


def read_labels(path: Path, like: Volume) -> Volume:
    """A label map (`read_label_map`) that lies on the grid of `like`. Raises `InputError` also if it does not."""
    labels = read_label_map(path)
    if labels.data.shape != like.data.shape:
        found, expected = (" × ".join(str(n) for n in reversed(v.data.shape)) for v in (labels, like))
        raise InputError(
            f"{path}: the label map has {found} voxels, but the CT has {expected}. Resample it to the CT's grid."
        )
    last = (torch.tensor([0.0, n - 1], dtype=torch.float64) for n in reversed(like.data.shape))
    corners = torch.cartesian_prod(*last)
    shift = labels.lps_from_index - like.lps_from_index
    apart = (corners @ shift[:3, :3].T + shift[:3, 3]).norm(dim=1).max().item()
    if apart > 0.05 * min(like.spacing_mm):
        raise InputError(
            f"{path}: the label map lies on another grid than the CT (its corners are up to {apart:.3g} mm away). "
            "Resample it to the CT's grid."
        )
    return Volume(labels.data, like.lps_from_index)


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume; the suffix chooses the format (.nii.gz, .nrrd, .mha). HU (float) are stored as whole numbers.

    Raises `OSError` that names the file if it cannot be written.
    """
    data = volume.data.numpy()
    if data.dtype.kind == "f":
        data = np.clip(np.rint(data), -32768, 32767).astype(np.int16)
    image = sitk.GetImageFromArray(data)
    spacing = np.array(volume.spacing_mm)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((volume.lps_from_index[:3, :3].numpy() / spacing).ravel().tolist())
    image.SetOrigin(volume.lps_from_index[:3, 3].tolist())
    with temporary_file(Path(path)) as part:
        try:
            with quiet():
                sitk.WriteImage(image, str(part), useCompression=True)
        except RuntimeError as error:
            reason = (str(error).strip().splitlines() or ["unknown reason"])[-1][:200]
            raise OSError(f"{path}: cannot be written ({reason}).") from error
