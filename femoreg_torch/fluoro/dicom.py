"""Pixels of DICOM X-ray images (XA, RF, CR, DX) as intensities or their logarithms (PS3.3 C.7.6.3, C.8.7, C.8.11).

Windows (VOI LUT) and presentation LUTs are for looking: they cut grey values off and bend them, and are not applied.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from femoreg_torch.arrays import check_pixels, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro.suffixes import ITK_SUFFIXES, PICTURE_SUFFIXES, SCREEN_SUFFIXES
from femoreg_torch.fluoro.tags import Tags, find_value, read_tags, value_in
from femoreg_torch.paths import check_readable
from femoreg_torch.volume.dicom.headers import damaged_header, is_dicom

Frames = tuple[int, ...] | Literal["mean"]  # of a cine run: numbers from 1, averaged, or all of them
Values = NDArray[Any]
_PIXEL_TAGS = (
    "SOPClassUID", "SOPInstanceUID", "Modality", "NumberOfFrames", "SamplesPerPixel", "PhotometricInterpretation",
    "PlanarConfiguration", "Rows", "Columns", "BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation",
    "PixelData",
)  # fmt: skip
_SECONDARY_CAPTURES = "1.2.840.10008.5.1.4.1.1.7"  # what their SOP classes begin with
_SAME_DEG = 0.5  # between frames of an arm that stands still
SCREEN = (
    "is a picture of a screen: 8 bits, with a window and a curve that nobody knows. Take the DICOM file of the C-arm "
    "itself where there is one"
)
_RADIOGRAPHS = ("CR", "DX")  # which are shown with bone bright, where fluoroscopy has it dark


@dataclass(frozen=True)
class DicomImage:
    """One image of a DICOM file."""

    values: Values  # (H, W): bone dark where `intensity` is not log
    tags: Tags
    intensity: Literal["raw", "log"] | None  # what the header says the values are
    padding: NDArray[np.bool_] | None  # (H, W) pixels that hold no image
    remarks: tuple[str, ...]  # for the user
    asks: str | None  # what the header leaves open and the case has to say: a question in words
    bone_is_dark: bool = False  # whether the header says so of the values, and not what they are


def carm_settings(path: Path) -> dict[str, Any]:
    """Settings of a C-arm, for `carm_from_dict`, from the header of a DICOM image.

    Raises `InputError` that names the tags that are missing.
    """
    if path.name.lower().endswith(PICTURE_SUFFIXES + SCREEN_SUFFIXES + ITK_SUFFIXES):
        raise InputError(
            f"{path}: is no DICOM file, whose header could tell the C-arm. Name a preset, or write its settings "
            "under `carm:`: sdd_mm, pixel_mm and shape."
        )
    tags = read_header(path)
    told = {"sdd_mm": tags.sdd_mm, "pixel_mm": tags.pixel_mm, "shape": tags.shape}
    names = {"sdd_mm": "DistanceSourceToDetector", "pixel_mm": "ImagerPixelSpacing", "shape": "Rows, Columns"}
    if missing := [key for key, value in told.items() if value is None]:
        raise InputError(
            f"{path}: the header does not say {', '.join(f'`{key}` ({names[key]})' for key in missing)}. Write the "
            "C-arm's settings under `carm:`: sdd_mm, pixel_mm and shape."
        )
    found: dict[str, Any] = {key: list(v) if isinstance(v, tuple) else v for key, v in told.items()}
    if tags.principal_point_px is not None:
        found["principal_point_px"] = list(tags.principal_point_px)
    return found


def read_header(path: Path) -> Tags:
    """What the header of a DICOM image says. Raises `InputError`."""
    with damaged_header(path):
        return _tags(_dataset(path, stop_before_pixels=True), path)


def _dataset(path: Path, **options: Any) -> Any:
    import pydicom  # a fifth of a second, and most images are of other kinds
    from pydicom.errors import InvalidDicomError
    from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian

    check_readable(Path(path))
    try:
        dataset = pydicom.dcmread(path, force=is_dicom(path), **options)  # some are written without a preamble
    except InvalidDicomError as error:
        raise InputError(
            f"{path}: not a DICOM file, and its name ends in no known suffix of an image "
            f"({', '.join(PICTURE_SUFFIXES + SCREEN_SUFFIXES + ITK_SUFFIXES)}). Save it as 16-bit TIFF or PNG."
        ) from error
    if "TransferSyntaxUID" not in dataset.file_meta:  # nor with what says how they are coded, which the first tags show
        implicit, _ = dataset.original_encoding
        dataset.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian
    return dataset


def _tags(dataset: Any, path: Path) -> Tags:
    try:
        return read_tags(dataset)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_dicom(path: Path, frames: Frames | None) -> DicomImage:
    """An image of a DICOM file; several frames are averaged.

    Raises `InputError` for a file that is no DICOM image, for a cine run without `frames`, for frames that it does not
    have or whose C-arm moved, and for a colour image.
    """
    try:
        with quiet():
            return _read(path, frames)
    except InputError:
        raise
    except Exception as error:  # pydicom's readers and decoders raise whatever their parsing runs into
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: the DICOM file holds no image that can be decoded ({reason}). Export it anew, uncompressed."
        ) from error


def _read(path: Path, frames: Frames | None) -> DicomImage:
    dataset = _dataset(path)
    check_pixels(path, int(dataset.get("Rows") or 1), int(dataset.get("Columns") or 1))
    if dataset.get("PhotometricInterpretation") == "PALETTE COLOR":
        raise InputError(f"{path}: a colour image, but fluoroscopy has one value per pixel. Export it as greyscale.")
    numbers = _numbers(dataset, frames, path)
    _keep_groups(dataset, numbers, path)
    tags = _tags(dataset, path)
    stored = _pixels(dataset, numbers)
    of_a_screen = stored.ndim == 3 or str(dataset.get("SOPClassUID")).startswith(_SECONDARY_CAPTURES)
    if stored.ndim == 3 and stored.shape[-1] == 3:
        if (stored != stored[..., :1]).any():
            return DicomImage(stored, tags, None, None, (), None)  # refused by its shape
        stored = stored[..., 0]
    padding = _padding(dataset, stored)
    relation = str(find_value(dataset, "PixelIntensityRelationship") or "")
    values, lowest, highest, linear = _after_modality(dataset, stored, relation)
    sign = find_value(dataset, "PixelIntensityRelationshipSign")
    if sign is None:
        inverted = dataset.get("PhotometricInterpretation") == "MONOCHROME1"
    else:  # of the stored pixels, which a rescale may have turned over (PS3.3, C.8.11.3.1.2)
        inverted = (sign == -1) != (float(dataset.get("RescaleSlope") or 1) < 0)
    if inverted and not linear:  # a LUT to linear values says itself which are high
        values = lowest + highest - values
    remarks = [SCREEN] if of_a_screen and int(dataset.get("BitsStored", 16)) <= 8 else []
    asks: str | None = None
    intensity: Literal["raw", "log"] | None = None
    if relation == "LIN" or linear:
        intensity = "raw"
    elif relation == "LOG":
        intensity = "log"
        values = values.max() - values  # with the sign taken care of, bone is dark; attenuation has it bright
        remarks.append("holds logarithms of unknown base, so that materials cannot be told from them")
    elif relation == "DISP":
        remarks.append("was processed for display: its grey values are no intensities")
        asks = "was processed for display (PixelIntensityRelationship DISP)"
    elif tags.modality in _RADIOGRAPHS:
        asks = f"is a radiograph ({tags.modality}) and does not say what its values are (PixelIntensityRelationship)"
    if str(dataset.get("LossyImageCompression") or "") == "01":
        remarks.append("was compressed with loss")
    return DicomImage(values, tags, intensity, padding, tuple(remarks), asks, intensity is None and sign is not None)


def _numbers(dataset: Any, frames: Frames | None, path: Path) -> tuple[int, ...]:
    """Which frames are meant, from 0."""
    count = int(dataset.get("NumberOfFrames") or 1)
    if frames is None:
        if count > 1:
            raise InputError(
                f"{path}: holds several frames, one was expected. Name one in the view, `frames: 1` (`--frame 1` of "
                "`femoreg detect`), several to be averaged, `frames: [1, 2]`, or `frames: mean`."
            )
        return (0,)
    chosen: Sequence[int] = range(1, count + 1) if frames == "mean" else frames
    if outside := [n for n in chosen if not 1 <= n <= count]:
        raise InputError(f"{path}: there is no frame {outside[0]}, it holds {count}, numbered from 1.")
    if len(chosen) > 1 and dataset.get("PositionerMotion") == "DYNAMIC":
        raise InputError(f"{path}: the C-arm moved during this run, so frames cannot be averaged. Name one frame.")
    return tuple(n - 1 for n in chosen)


def _keep_groups(dataset: Any, numbers: tuple[int, ...], path: Path) -> None:
    """Leave what an enhanced image says of each frame to those that are meant. Raises `InputError` if the arm moved."""
    groups = dataset.get("PerFrameFunctionalGroupsSequence")
    if not groups:
        return
    meant = [groups[n] for n in numbers if n < len(groups)]
    for keyword in ("PositionerPrimaryAngle", "PositionerIsocenterPrimaryAngle"):
        told = (value_in(group, keyword) for group in meant)
        angles = [float(angle) for angle in told if angle is not None]
        if angles and max(angles) - min(angles) > _SAME_DEG:
            raise InputError(f"{path}: the C-arm moved between these frames, so they cannot be averaged. Name one.")
    dataset.PerFrameFunctionalGroupsSequence = meant


def _pixels(dataset: Any, frames: tuple[int, ...]) -> Values:
    """Stored values (H, W), or (H, W, 3); the mean, float64, of several frames."""
    from pydicom.pixels import pixel_array

    if not dataset.file_meta.TransferSyntaxUID.is_compressed:
        read = [_stored_bits(dataset, pixel_array(dataset, index=n, correct_unused_bits=False)) for n in frames]
    else:
        try:
            read = [pixel_array(dataset, index=n) for n in frames]
        except (NotImplementedError, RuntimeError):  # a compression that pydicom has no decoder for, as lossless JPEG
            everything = _by_gdcm(dataset)
            read = [everything[n] for n in frames]
    return read[0] if len(read) == 1 else np.mean(read, axis=0)


def _by_gdcm(dataset: Any) -> Values:
    """Stored values (F, H, W) of a compressed image by GDCM, in SimpleITK, which knows all kinds of JPEG.

    It applies what it finds of rescaling, so it is given the pixels and what describes them alone, and turns the values
    of MONOCHROME1 over, so it is told the other one. Raises `RuntimeError` for what it cannot decode either.
    """
    from pydicom.dataset import Dataset

    bare = Dataset()
    bare.file_meta = dataset.file_meta
    for keyword in _PIXEL_TAGS:
        if keyword in dataset:
            bare.add(dataset[keyword])
    if bare.get("PhotometricInterpretation") == "MONOCHROME1":
        bare.add_new("PhotometricInterpretation", "CS", "MONOCHROME2")  # the element of the data set stays as it is
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.dcm"
        bare.save_as(path, enforce_file_format=True)
        try:
            values = sitk.GetArrayFromImage(sitk.ReadImage(str(path), imageIO="GDCMImageIO"))
        except RuntimeError as error:  # which names lines of ITK's source
            kind = dataset.file_meta.TransferSyntaxUID.name
            raise RuntimeError(f"compressed as {kind}, and damaged or of a kind that is not read") from error
    return values if values.ndim > 2 else values[None]


def _stored_bits(dataset: Any, pixels: Values) -> Values:
    """Pixels without what else may stand in unused bits, such as overlays; the bits that are used end at HighBit."""
    if pixels.dtype.kind not in "iu" or pixels.ndim != 2:
        return pixels
    stored, high = int(dataset.BitsStored), int(dataset.get("HighBit", dataset.BitsStored - 1))
    shift, width = high + 1 - stored, 8 * pixels.dtype.itemsize
    if shift < 0 or stored > width or (shift == 0 and stored == width):
        return pixels
    native = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)  # of a file in big endian
    bits = (native.view(f"u{pixels.dtype.itemsize}").astype(np.int64) >> shift) & (2**stored - 1)
    if dataset.PixelRepresentation:
        bits = np.where(bits >= 2 ** (stored - 1), bits - 2**stored, bits)
    return bits


def _padding(dataset: Any, stored: Values) -> NDArray[np.bool_] | None:
    """Pixels (H, W) that hold no image, by PixelPaddingValue (and its range)."""
    value = dataset.get("PixelPaddingValue")
    if value is None:
        return None
    low, high = sorted((int(value), int(dataset.get("PixelPaddingRangeLimit", value))))
    padding = (stored >= low) & (stored <= high)
    return padding if padding.any() else None


def _after_modality(dataset: Any, stored: Values, relation: str) -> tuple[Values, float, float, bool]:
    """Values after the modality LUT, their least and greatest possible, and whether a LUT made logarithms linear.

    In X-ray images the modality LUT of logarithmic pixels leads back to values that are linear in the intensity of the
    beam; enhanced images say so in a LUT of their own (TO_LINEAR).
    """
    from pydicom.pixels import apply_modality_lut

    bits = int(dataset.get("BitsStored", 16))
    lowest = -(2 ** (bits - 1)) if dataset.get("PixelRepresentation") else 0
    ends = np.array([lowest, lowest + 2**bits - 1])
    for keyword in ("RescaleSlope", "RescaleIntercept"):
        if dataset.get(keyword) is None:  # left empty, or that of an enhanced image
            setattr(dataset, keyword, find_value(dataset, keyword))
    if dataset.RescaleSlope is None or dataset.RescaleIntercept is None:
        del dataset.RescaleSlope, dataset.RescaleIntercept
    for item in find_value(dataset, "PixelIntensityRelationshipLUTSequence") or ():
        if item.get("LUTFunction") == "TO_LINEAR":
            dataset.ModalityLUTSequence = [item]  # in place of what the file has for display
    has_table = bool(dataset.get("ModalityLUTSequence"))
    whole = np.rint(stored).astype(np.int64) if has_table else stored
    values = apply_modality_lut(whole, dataset).astype(np.float64)
    if "BitsStored" not in dataset:  # floating-point pixels
        low, high = float(stored.min()), float(stored.max())
    else:
        low, high = sorted(float(v) for v in apply_modality_lut(ends, dataset))
    return values, low, high, relation == "LOG" and has_table
