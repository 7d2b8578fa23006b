"""Reading and writing of volumes. Whatever the index order of a file, index axes inside run along +L, +P, +S."""

import errno
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import SimpleITK as sitk
import torch
from torch import Tensor

from femoreg_torch.anatomy.tables import LARGEST_ID
from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, in_mm
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry.rigid import FARTHEST_MM
from femoreg_torch.paths import check_readable
from femoreg_torch.volume.dicom.headers import is_dicom
from femoreg_torch.volume.dicom.series import choose_series
from femoreg_torch.volume.dicom.slices import read_series
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.itk import read_itk
from femoreg_torch.volume.segments import has_names, read_segments
from femoreg_torch.volume.text_headers import check_voxel_size

_LEAST_INSIDE = 0.98  # of what a label map labels, less than this within the CT is told
_FINEST_MM, _COARSEST_MM = 0.01, 50.0  # voxels: of a micro-CT, and more than those of any clinical scan
_FAT_HU, _BONE_HU = -50, 200  # every CT of a hip holds something below the first and something above the second


def _read(path: Path, series: str | None = None) -> tuple[sitk.Image, tuple[str, ...]]:
    """The stored volume, and what had to be done to it in words. Raises `InputError`."""
    check_readable(path, expected="file or folder")
    if not (path.is_dir() or is_dicom(path)):
        return read_itk(path), ()
    try:
        with quiet():
            return read_series(choose_series(path, series))
    except InputError:
        raise
    except Exception as error:  # pydicom's and GDCM's readers raise whatever their parsing runs into
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: the DICOM series cannot be read ({reason}). Export it anew.") from error


def _oriented(image: sitk.Image, path: Path) -> sitk.Image:
    """The volume with its index axes turned to run closest to +L, +P, +S. Raises `InputError`.

    Index axes may form a left-handed set, as dcm2niix and FSL store them: the direction matrix says where left is, and
    turning the axes makes them right-handed.
    """
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1 or min(image.GetSize()) < 2:
        size = " × ".join(str(n) for n in image.GetSize())
        raise InputError(
            f"{path}: a 3-D volume of one channel was expected, found {size} voxels of "
            f"{image.GetNumberOfComponentsPerPixel()} channel(s). Save one volume of it as a file of its own."
        )
    check_voxel_size(path)
    spacing = image.GetSpacing()
    if not (min(spacing) >= _FINEST_MM and max(spacing) <= _COARSEST_MM):
        told = " × ".join(f"{s:.3g}" for s in spacing)
        raise InputError(
            f"{path}: voxels of {told} mm were found, {_FINEST_MM:g} to {_COARSEST_MM:g} mm expected. Is it in mm?"
        )
    if max(map(abs, image.GetOrigin())) > FARTHEST_MM:
        raise InputError(f"{path}: its origin lies {in_mm(max(map(abs, image.GetOrigin())))} away. Export it anew.")
    return sitk.DICOMOrient(image, "LPS")


def _lps_from_index(image: sitk.Image) -> Tensor:
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return torch.from_numpy(affine)


def read_volume(path: str | Path) -> Volume:
    """Any volume as float32 (Z, Y, X) on its own grid, index axes closest to +L, +P, +S, exact affine (also oblique).

    `path` is a NIfTI, NRRD or MHA file, the folder of one DICOM series, or one of its files. Raises `InputError` for
    what cannot be read, is not 3-D, or holds values that are not finite.
    """
    return read_volume_told(path)[0]


def read_volume_told(path: str | Path, series: str | None = None) -> tuple[Volume, tuple[str, ...]]:
    """As `read_volume`, and what had to be done to it in words.

    `series` names one of several DICOM series: its number, its UID or a part of its description. Raises `InputError` as
    `read_volume` does.
    """
    path = Path(path)
    image, told = _read(path, series)
    image = _oriented(image, path)
    stored = sitk.GetArrayViewFromImage(image)
    data = torch.from_numpy(stored.astype(np.float32))
    if stored.dtype.kind == "f" and not torch.isfinite(data).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite). Repair or export it anew.")
    return Volume(data, _lps_from_index(image)), told


def read_ct(path: str | Path) -> Volume:
    """A CT in HU, as `read_volume` reads it. Raises `InputError` for what that refuses and for what is not in HU."""
    return read_ct_told(path)[0]


def read_ct_told(path: str | Path, series: str | None = None) -> tuple[Volume, tuple[str, ...]]:
    """As `read_ct`, and what had to be done to it in words; `series` as for `read_volume_told`. Raises `InputError`."""
    volume, told = read_volume_told(path, series)
    lowest, highest = (v.item() for v in volume.data.aminmax())
    if lowest == highest:
        raise InputError(f"{path}: every voxel is {lowest:g}; a CT in HU was expected.")
    if lowest > _FAT_HU or highest < _BONE_HU:
        raise InputError(
            f"{path}: values run from {lowest:g} to {highest:g}, but a CT in HU has air or fat (below {_FAT_HU}) and "
            f"bone (above {_BONE_HU}). Export it in Hounsfield units (rescale applied, no window, no attenuation)."
        )
    return volume, told


def read_label_map(path: Path) -> Volume:
    """A label map by itself, on its own grid, oriented as by `read_volume`.

    A volume, or a segmentation whose parts have names (`femoreg_torch.volume.segments`): a `.seg.nrrd` file of 3D
    Slicer, a folder with a mask for each bone, or DICOM SEG. Labels are uint8 where they fit, else int32. Raises
    `InputError` for what `read_volume` refuses, and for values that are no whole numbers from 0 to 65535.
    """
    return _label_map_told(Path(path), None)[0]


def _label_map_told(path: Path, ids: Collection[int] | None) -> tuple[Volume, tuple[str, ...]]:
    stored, told = read_segments(path, ids) if has_names(path) else (read_itk(path), ())
    image = _oriented(stored, path)
    data = sitk.GetArrayViewFromImage(image)
    whole = data.dtype.kind in "iu" or (data == np.floor(data)).all()
    if not (data.min() >= 0 and data.max() <= LARGEST_ID and whole):
        raise InputError(
            f"{path}: a label map of whole numbers from 0 to {LARGEST_ID} was expected, found {data.min():g} to "
            f"{data.max():g}{'' if whole else ', and fractions between them'}. Export the segmentation as a label map"
            f"{'' if whole else ', and resample it by nearest neighbour'}."
        )
    labels = data.astype(np.uint8 if data.max() <= 255 else np.int32)
    return Volume(torch.from_numpy(labels), _lps_from_index(image)), told


def read_labels(path: Path, like: Volume) -> Volume:
    """A label map (`read_label_map`) on the grid of `like`, by nearest neighbour if its own is another."""
    return read_labels_told(path, like).labels


class LabelsTold(NamedTuple):
    """A label map on the grid of a CT, and what is told of it in words."""

    labels: Volume
    done: tuple[str, ...]  # what had to be done to it
    against: tuple[str, ...]  # what speaks against where it lies


def read_labels_told(path: Path, like: Volume, ids: Collection[int] | None = None) -> LabelsTold:
    """A label map on the grid of `like`, the CT.

    A map on another grid is resampled by nearest neighbour. Of a segmentation whose parts have names, only those with
    the values `ids` are read; None: all. Raises `InputError` as `read_label_map` does, and for a map that is empty,
    or of which nothing lies in the CT.
    """
    labels, told = _label_map_told(Path(path), ids)
    if not labels.data.any():
        raise InputError(f"{path}: the label map is empty: no voxel has a label. Export it anew.")
    against: tuple[str, ...] = ()
    if labels.data.shape == like.data.shape:
        near = 0.05 * min(like.spacing_mm)
        shift = labels.lps_from_index - like.lps_from_index
        beside = shift[:3, 3]
        corners = torch.cartesian_prod(*(beside.new_tensor([0.0, n - 1]) for n in like.data.shape[::-1]))
        turned = corners @ shift[:3, :3].T
        if (turned + beside).norm(dim=1).max() <= near:
            return LabelsTold(Volume(labels.data, like.lps_from_index), told, ())
        if turned.norm(dim=1).max() <= near:
            against = (_origin_doubted(Path(path), beside, like),)
    grid = sitk.Resample(_image(labels), _image(like), sitk.Transform(), sitk.sitkNearestNeighbor, 0)
    moved = Volume(torch.from_numpy(sitk.GetArrayFromImage(grid)), like.lps_from_index)
    labelled = int(labels.data.count_nonzero()) * float(np.prod(labels.spacing_mm))
    kept = int(moved.data.count_nonzero()) * float(np.prod(like.spacing_mm))
    if not kept:
        raise InputError(
            f"{path}: nothing of the label map lies in the CT. Check that both are of the same scan, and for RAS/LPS "
            "mix-ups."
        )
    spacing = " × ".join(f"{s:.3g}" for s in labels.spacing_mm)
    note = f"the label map {path.name} has a grid of its own ({spacing} mm): it was resampled by nearest neighbour"
    if kept < _LEAST_INSIDE * labelled:
        note += f", and {100 * (1 - kept / labelled):.0f} % of what it labels lies outside the CT"
    return LabelsTold(moved, (*told, note), against)


def _origin_doubted(path: Path, beside: Tensor, like: Volume) -> str:
    """That a label map has the voxels of its CT, but not its origin: it lies `beside` (3,) mm LPS.

    Of the steps that programs confuse, half a voxel along every axis is one: an origin is the middle of the first
    voxel, and some take it for its corner.
    """
    voxels = torch.linalg.solve(like.lps_from_index[:3, :3], beside).abs()
    half = " (half a voxel along each axis: was the origin taken for a corner?)" if _is_half(voxels) else ""
    by = ", ".join(f"{mm:z.2f}" for mm in beside.tolist())
    return (
        f"the label map {path.name} has as many voxels as the CT, as large and along the same axes, but lies ({by}) mm "
        f"LPS beside it{half}: if it was drawn on this CT, give it the CT's origin, for one of both headers is wrong"
    )


def _is_half(voxels: Tensor) -> bool:
    return bool(((voxels - 0.5).abs() < 0.05).all())


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume; the suffix chooses the format (.nii.gz, .nrrd, .mha). HU (float) are stored as whole numbers.

    Raises `OSError` that names the file if it cannot be written.
    """
    if volume.data.dtype.is_floating_point:
        volume = volume.with_data(volume.data.round().clamp(-32768, 32767).to(torch.int16))
    write_image(path, _image(volume))


def write_labels_like(path: Path, labels: Volume, ct: Path) -> None:
    """Write a label map that was made on a CT as `read_ct` gives it, with the index order of the CT's own file.

    Of a DICOM series the order is that of `labels`. Raises `OSError` that names the file if it cannot be written.
    """
    image = _image(labels)
    if ct.is_file() and not is_dicom(ct):
        stored = read_itk(ct)
        if stored.GetDimension() == 4:
            stored = stored[:, :, :, 0]
        code = sitk.DICOMOrientImageFilter.GetOrientationFromDirectionCosines(stored.GetDirection())
        image = sitk.DICOMOrient(image, code)
        if image.GetSize() == stored.GetSize():
            image.CopyInformation(stored)
    write_image(path, image)


def write_image(path: Path, image: sitk.Image) -> None:
    """Write an image, whole or not at all. Raises `OSError` that names the file if it cannot be written."""
    with temporary_file(Path(path)) as part:
        try:
            with quiet():
                sitk.WriteImage(image, str(part), useCompression=True)
        except RuntimeError as error:
            reason = (str(error).strip().splitlines() or ["unknown reason"])[-1][:200]
            raise OSError(errno.EIO, f"cannot be written ({reason})", str(path)) from error
        if not _holds(part, image):
            raise OSError(errno.ENOSPC, "cannot be written whole. Is the disk full?", str(path))


def _holds(path: Path, image: sitk.Image) -> bool:
    """Whether a file has all voxels of an image. Where a full disk cuts a NIfTI off, ITK's writer says nothing."""
    try:
        written = read_itk(path)
    except InputError:  # damaged
        return False
    return np.array_equal(sitk.GetArrayViewFromImage(written), sitk.GetArrayViewFromImage(image))


def _image(volume: Volume) -> sitk.Image:
    image = sitk.GetImageFromArray(volume.data.numpy())
    spacing = np.array(volume.spacing_mm)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((volume.lps_from_index[:3, :3].numpy() / spacing).ravel().tolist())
    image.SetOrigin(volume.lps_from_index[:3, 3].tolist())
    return image
