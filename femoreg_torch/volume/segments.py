"""Segmentations whose parts have names: `.seg.nrrd` of 3D Slicer, a folder with a mask for each bone, DICOM SEG, NIfTI
with a label table in its header, as TotalSegmentator writes it.

They become label maps with one value per voxel. Of two parts that overlap, the first keeps the voxels they share.

Slicer keeps names in custom fields of the header, `Segment0_Name`, `Segment0_LabelValue`, `Segment0_Layer`, …, and
overlapping segments in layers, the components of a voxel: 3D Slicer documentation, developer guide, Segmentations,
"Segmentation labelmap file format". Names of DICOM segments are their Segment Labels (DICOM PS3.3, C.8.20.4). The label
table of a NIfTI file is XML in an extension of its header, elements `Label` with a `Key`: wasserth/TotalSegmentator,
totalsegmentator/nifti_ext_header.py, after Connectome Workbench.
"""

import re
import zlib
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.paths import check_readable
from femoreg_torch.volume.dicom.headers import is_dicom
from femoreg_torch.volume.dicom.series import series_in
from femoreg_torch.volume.itk import image_of, read_itk
from femoreg_torch.volume.text_headers import NRRD_SUFFIXES, check_text_header

SEGMENTATION_SUFFIX = ".seg.nrrd"
_MASK_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha", ".mhd")
_NIFTI_SUFFIXES = (".nii", ".nii.gz")
_NAME = re.compile(r"Segment(\d+)_Name")
_SAME_GRID_MM = 1e-3


@dataclass(frozen=True)
class Segment:
    """One part of a segmentation."""

    name: str
    label: int  # its value in the label map
    layer: int = 0  # of a segmentation of 3D Slicer
    value: int = 1  # in its layer, or in the label map
    path: Path | None = None  # of its mask


def has_names(path: Path) -> bool:
    """Whether a file or folder is a segmentation whose parts have names."""
    named = path.is_dir() or path.name.lower().endswith(SEGMENTATION_SUFFIX) or is_dicom(path)
    return named or bool(_nifti_segments(path))


def segment_names(path: Path) -> dict[str, tuple[int, ...]]:
    """Label values of each part of a segmentation by its name; several if several parts have that name.

    Raises `InputError` if the file or folder is no segmentation with names.
    """
    found: dict[str, tuple[int, ...]] = {}
    for segment in _segments(path):
        found[segment.name] = (*found.get(segment.name, ()), segment.label)
    return found


def read_segments(path: Path, labels: Collection[int] | None = None) -> tuple[sitk.Image, tuple[str, ...]]:
    """The label map of a segmentation with names, with the values of `segment_names`; and what overlaps, in words.

    Parts whose values are not in `labels` are left out; None: all are read. Raises `InputError`.
    """
    segments = [one for one in _segments(path) if labels is None or one.label in labels]
    if not segments:
        raise InputError(f"{path}: none of its parts has one of the labels {sorted(labels or ())}. Check `ct.bones`.")
    if path.is_dir() and _masks(path):
        return _merged(segments, _mask_reader(path))
    if path.is_dir() or is_dicom(path):
        return _merged(segments, _dicom_reader(path))
    if all(one.layer == 0 and one.label == one.value for one in segments):  # a label map with names
        image = read_itk(path)
        if image.GetNumberOfComponentsPerPixel() == 1:
            return image, ()
    return _merged(segments, _layer_reader(path))


def _segments(path: Path) -> list[Segment]:
    check_readable(path, expected="file or folder")
    if path.is_dir() and (masks := _masks(path)):
        names = (re.sub(r"\.(seg\.nrrd|nii\.gz|nii|nrrd|mha|mhd)$", "", mask.name, flags=re.I) for mask in masks)
        return [Segment(name, n, path=mask) for n, (name, mask) in enumerate(zip(names, masks, strict=True), 1)]
    if path.is_dir() or is_dicom(path):
        return _dicom_segments(path)
    return _nifti_segments(path) or _slicer_segments(path)


def _merged(
    segments: Iterable[Segment], mask_of: Callable[[Segment], tuple[NDArray[np.bool_], sitk.Image]]
) -> tuple[sitk.Image, tuple[str, ...]]:
    """One label map of several masks, and which of them overlap."""
    labels: NDArray[np.int32] | None = None
    geometry: sitk.Image | None = None
    told, name_of = [], {}
    for segment in segments:
        mask, geometry = mask_of(segment)
        if labels is None:
            labels = np.zeros(mask.shape, np.int32)
        name_of[segment.label] = segment.name
        shared, counts = np.unique(labels[mask], return_counts=True)
        for other, count in zip(shared.tolist(), counts.tolist(), strict=True):
            if other and name_of[other] != segment.name:
                told.append(f"{count} voxels lie in both {name_of[other]} and {segment.name} and count as the former")
        labels[mask & (labels == 0)] = segment.label
    assert labels is not None
    assert geometry is not None
    image = sitk.GetImageFromArray(labels)
    image.SetOrigin(geometry.GetOrigin())
    image.SetSpacing(geometry.GetSpacing())
    image.SetDirection(geometry.GetDirection())
    return image, tuple(told)


def _masks(folder: Path) -> list[Path]:
    """The masks in a folder, one file each, in order of their names."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.name.lower().endswith(_MASK_SUFFIXES) and not path.name.startswith("._")  # macOS's
    )


def _mask_reader(folder: Path) -> Callable[[Segment], tuple[NDArray[np.bool_], sitk.Image]]:
    first: list[sitk.Image] = []

    def mask_of(segment: Segment) -> tuple[NDArray[np.bool_], sitk.Image]:
        assert segment.path is not None
        image = read_itk(segment.path)
        if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
            raise InputError(f"{segment.path}: a mask in 3-D of one channel was expected.")
        first.append(image)
        if not _same_grid(first[0], image):
            raise InputError(
                f"{segment.path}: lies on another grid than the other masks in {folder}. Export all on one grid."
            )
        del first[1:]
        array = sitk.GetArrayFromImage(image)
        values = np.unique(array)
        if len(values) > 2 or values[0] < 0:
            raise InputError(
                f"{segment.path}: a mask of zeros and ones was expected, found {len(values)} values from "
                f"{values[0]:g} to {values[-1]:g}. Give a label map as a file, a folder for masks alone."
            )
        return array > 0, image

    return mask_of


def _same_grid(one: sitk.Image, other: sitk.Image) -> bool:
    def frame(image: sitk.Image) -> NDArray[np.float64]:
        corners = [image.TransformIndexToPhysicalPoint(c) for c in ((0, 0, 0), tuple(n - 1 for n in image.GetSize()))]
        return np.array([*corners, np.reshape(image.GetDirection(), (3, 3)) @ image.GetSpacing()])

    return one.GetSize() == other.GetSize() and bool(abs(frame(one) - frame(other)).max() < _SAME_GRID_MM)


def _nifti_segments(path: Path) -> list[Segment]:
    """The label table in the header of a NIfTI file; empty where there is none."""
    if not path.is_file() or not path.name.lower().endswith(_NIFTI_SUFFIXES):
        return []
    import nibabel  # takes a tenth of a second, beside the reading of images

    try:
        image: Any = nibabel.load(path)  # its declared type is that of all formats
    except (nibabel.filebasedimages.ImageFileError, OSError, EOFError, ValueError, zlib.error):
        return []  # which whoever reads the voxels tells
    for extension in image.header.extensions:
        text = extension.get_content()
        if not isinstance(text, bytes) or b"<LabelTable" not in text:
            continue
        try:
            labels = list(ElementTree.fromstring(text.strip(b"\0 \n")).iter("Label"))
            found = [(str(label.text).strip(), int(label.attrib["Key"])) for label in labels]
        except (ElementTree.ParseError, KeyError, ValueError) as error:
            raise InputError(
                f"{path}: the label table in its header is damaged ({error}). Save the map without it, and name "
                "a table of its ids as `bones`."
            ) from error
        return [Segment(name, key, value=key) for name, key in found if key > 0]
    return []


def _slicer_segments(path: Path) -> list[Segment]:
    unnamed = (
        f"{path}: names no segments. In 3D Slicer, save the segmentation itself (.seg.nrrd), not a label map of it."
    )
    if not path.name.lower().endswith(NRRD_SUFFIXES):
        raise InputError(unnamed)
    check_text_header(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO")
    reader.SetFileName(str(path))
    try:
        with quiet():
            reader.ReadImageInformation()
            fields = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
    except (RuntimeError, UnicodeDecodeError, TypeError) as error:  # the last for keys that are no text
        raise InputError(f"{path}: cannot be read; a segmentation of 3D Slicer (.seg.nrrd) was expected.") from error
    numbers = sorted(int(match[1]) for match in map(_NAME.fullmatch, fields) if match)
    if not numbers:
        raise InputError(unnamed)
    values = [_whole(fields, f"Segment{n}_LabelValue", 1, path) for n in numbers]
    layers = [_whole(fields, f"Segment{n}_Layer", 0, path, "0") for n in numbers]
    there = reader.GetNumberOfComponents()
    if max(layers) >= there:
        raise InputError(f"{path}: names {max(layers) + 1} layers and holds {there}. Save it anew with 3D Slicer.")
    places = list(zip(layers, values, strict=True))
    if twice := [value for n, (layer, value) in enumerate(places) if (layer, value) in places[:n]]:
        raise InputError(f"{path}: label value {twice[0]} belongs to two segments. Save it anew with 3D Slicer.")
    labels = values if len(set(layers)) == 1 else [n + 1 for n in numbers]
    return [
        Segment(fields[f"Segment{n}_Name"], label, layer, value)
        for n, label, layer, value in zip(numbers, labels, layers, values, strict=True)
    ]


def _whole(fields: dict[str, str], key: str, least: int, path: Path, otherwise: str = "") -> int:
    text = fields.get(key, otherwise)
    if not (text.strip().isdecimal() and len(text.strip()) < 10 and int(text) >= least):
        raise InputError(
            f"{path}, {key}: a whole number from {least} was expected, found {shortened(text, 20)}. Save it anew with "
            "3D Slicer 4.11 or later."
        )
    return int(text)


def _layer_reader(path: Path) -> Callable[[Segment], tuple[NDArray[np.bool_], sitk.Image]]:
    image = read_itk(path)
    if image.GetDimension() != 3:
        raise InputError(f"{path}: a segmentation in 3-D was expected, found {image.GetDimension()} dimensions.")
    array = sitk.GetArrayViewFromImage(image)
    layers = array if array.ndim == 4 else array[..., None]

    def mask_of(segment: Segment) -> tuple[NDArray[np.bool_], sitk.Image]:
        return np.asarray(layers[..., segment.layer] == segment.value), image

    return mask_of


def _dicom_file(path: Path) -> Path:
    """The one file of a DICOM segmentation. Raises `InputError`."""
    if path.is_file():
        return path
    there = series_in(path)
    files = [part.path for one in there if one.modality == "SEG" for part in one.slices]
    if len(files) != 1:
        told = f"{len(files)} segmentations" if files else "neither masks nor a DICOM segmentation"
        raise InputError(
            f"{path}: holds {told}. Give a label map, a folder with a mask for each bone (hip_left.nii.gz, …), or one "
            "DICOM SEG file."
        )
    return files[0]


def _dicom_segments(path: Path) -> list[Segment]:
    import pydicom

    path = _dicom_file(path)
    header = pydicom.dcmread(path, stop_before_pixels=True, force=True)
    if header.get("Modality") != "SEG" or "SegmentSequence" not in header:
        raise InputError(
            f"{path}: a DICOM segmentation (SEG) was expected, found {header.get('Modality') or 'no modality'}."
        )
    numbered = ((str(one.SegmentLabel), int(one.SegmentNumber)) for one in header.SegmentSequence)
    return [Segment(name, number) for name, number in numbered if number > 0]  # 0 is a label map's background


def _dicom_reader(path: Path) -> Callable[[Segment], tuple[NDArray[np.bool_], sitk.Image]]:
    import highdicom  # half a second, and few segmentations are of this kind

    path = _dicom_file(path)
    try:  # what pydicom and highdicom raise for tags that lack or contradict one another
        segmentation = highdicom.seg.segread(path)
    except (AttributeError, KeyError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read as a DICOM segmentation ({error}). Export it as a label map."
        ) from error

    def mask_of(segment: Segment) -> tuple[NDArray[np.bool_], sitk.Image]:
        try:  # the same, and for frames that make no volume
            volume = segmentation.get_volume(segment_numbers=[segment.label])
        except (AttributeError, KeyError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}, segment {segment.name}: is no volume ({error}). Export it as a label map."
            ) from error
        share = np.asarray(volume.array[..., 0])  # of a fractional segmentation; else 0 or 1
        geometry = image_of(share.astype(np.uint8), volume.affine)
        return (share >= 0.5).transpose(2, 1, 0), geometry

    return mask_of
