"""A series of DICOM files as a volume with its true geometry.

GDCM, in SimpleITK, decodes the pixels, compressed ones as well, and applies each slice's rescale. Where the slices lie
is read here, from Image Position and Image Orientation (DICOM PS3.3, C.7.6.2), since ITK's reader of series passes over
missing slices, and over the shear of a tilted gantry.
"""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from femoreg_torch.errors import InputError
from femoreg_torch.volume.dicom.headers import Slice
from femoreg_torch.volume.dicom.series import MOST_LISTED, Series
from femoreg_torch.volume.itk import image_of

# What all files of a series have in common (DICOM PS3.3, A.1.2), and what they are of by it.
_IN_COMMON = {
    "PatientID": "patients",
    "PatientName": "patients",
    "StudyInstanceUID": "studies",
    "FrameOfReferenceUID": "frames of reference",
}
_AIR_HU = -1024.0  # what lies outside the slices of a tilted gantry
_SAME_PLACE_MM = 0.01  # slices that are closer are one
_SHEAR_MM = 0.3  # of the last slice against the first: what rounding of positions and axes may make of it
_ROUNDED_MM, _SAME_STEP = 0.03, 0.02  # of the step that a header tells: 0.625 mm may be written as 0.6
_MOST_STEP = 1.25  # in thicknesses of a slice: those of a reconstruction without gaps touch or overlap


def read_series(series: Series) -> tuple[sitk.Image, tuple[str, ...]]:
    """A series as a volume, and what was done to it in words.

    Slices are sorted along their normal. Those of a tilted gantry are brought onto a rectangular grid, by linear
    interpolation. Raises `InputError` for slices that are missing, doubled, unevenly spaced or of different kinds,
    patients, studies or frames of reference, and for pixels that cannot be decoded.
    """
    where = str(series.slices[0].path.parent)
    for one in series.slices:
        if not one.holds_pixels:
            raise InputError(f"{one.path}: holds fewer pixels than it claims, or none. Export the series anew.")
    if len(series.slices) == 1:
        if series.slices[0].whole("NumberOfFrames", 1) < 2:
            raise InputError(f"{series.slices[0].path}: is a single slice. Give the folder of the whole series.")
        return _multi_frame(series.slices[0].path), ()
    if several := [one for one in series.slices if one.whole("NumberOfFrames", 1) > 1]:
        raise InputError(
            f"{where}: {series.told} has {len(several)} files of several frames each ({several[0].path.name}, …). "
            "Export it with all frames in one file, or with a file for each slice."
        )
    _check_in_common(series, where)
    layout = _sorted_slices(series, where)
    told = _other_steps(series, layout, where)
    image = _decoded(layout.slices)
    image.SetOrigin(layout.origin.tolist())
    spacing = (*layout.spacing.tolist(), layout.step @ layout.axes[:, 2])
    image.SetSpacing([float(value) for value in spacing])
    image.SetDirection(layout.axes.ravel().tolist())
    lean = layout.step - (layout.step @ layout.axes[:, 2]) * layout.axes[:, 2]
    if np.linalg.norm(lean) * (len(layout.slices) - 1) <= _SHEAR_MM:  # which adds up from slice to slice
        return image, told
    angle = np.degrees(np.arcsin(np.linalg.norm(lean) / np.linalg.norm(layout.step)))
    note = f"the gantry was tilted by {angle:.1f}°: the slices of {where} were brought onto a rectangular grid"
    return _straightened(image, lean), (*told, note)


def _decoded(slices: Sequence[Slice]) -> sitk.Image:
    """The pixels of all slices, rescaled, as float32; by pydicom where GDCM cannot. Raises `InputError`."""
    for one in slices:
        stored, high = one.number("BitsStored"), one.number("HighBit")
        if stored is not None and high is not None and high != stored - 1:  # DICOM PS3.5, 8.1.1; GDCM shifts some of it
            raise InputError(
                f"{one.path}: its values end at bit {high:g} and have {stored:g} bits (HighBit, BitsStored), which is "
                "no DICOM of today. Export the series anew."
            )
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(one.path) for one in slices])
    reader.SetOutputPixelType(sitk.sitkFloat32)
    # GDCM turns the values of MONOCHROME1 over, which is a matter of how they are shown
    if all(one.header.get("PhotometricInterpretation") != "MONOCHROME1" for one in slices):
        with suppress(RuntimeError):  # some RLE, and files without a preamble
            return reader.Execute()
    return sitk.GetImageFromArray(np.stack([_pixels(one.path) for one in slices]))


def _pixels(path: Path) -> NDArray[np.float32]:
    import pydicom
    from pydicom.pixels import apply_rescale

    data = pydicom.dcmread(path, force=True)
    try:  # what pydicom and its decoders raise for tags that lack or contradict one another, and for broken pixels
        return apply_rescale(data.pixel_array, data).astype(np.float32)
    except (AttributeError, KeyError, NotImplementedError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: the slice cannot be decoded ({error}). Export the series anew.") from error


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where the slices of a series lie."""

    slices: tuple[Slice, ...]  # along the normal
    axes: NDArray[np.float64]  # (3, 3), columns: along the pixels of a row, along those of a column, normal
    spacing: NDArray[np.float64]  # (2,) along these
    origin: NDArray[np.float64]  # (3,) centre of the first pixel of the first slice, LPS mm
    step: NDArray[np.float64]  # (3,) from slice to slice


def _sorted_slices(series: Series, where: str) -> _Layout:
    first = series.slices[0]
    geometry = {
        name: first.numbers(name, count) for name, count in (("ImageOrientationPatient", 6), ("PixelSpacing", 2))
    }
    for name in ("ImageOrientationPatient", "PixelSpacing", "ImagePositionPatient"):
        lacking = [one.path.name for one in series.slices if name not in one.header]
        if lacking:
            raise InputError(
                f"{where}: {len(lacking)} slices have no {name} ({lacking[0]}, …). Export the series anew."
            )
    cosines, pixel = geometry["ImageOrientationPatient"], geometry["PixelSpacing"]
    positions = [one.numbers("ImagePositionPatient", 3) for one in series.slices]
    if cosines is None or pixel is None or any(position is None for position in positions):
        raise InputError(f"{where}: position, orientation or pixel spacing of a slice are no numbers. Export it anew.")
    if pixel.min() <= 0 or not cosines[:3].any() or not cosines[3:].any():
        raise InputError(f"{where}: pixel spacing or orientation of {first.path.name} is zero. Export the series anew.")
    _check_alike(series, cosines, pixel, where)
    row, column = cosines[:3] / np.linalg.norm(cosines[:3]), cosines[3:] / np.linalg.norm(cosines[3:])
    normal = np.cross(row, column)
    if abs(np.linalg.norm(normal) - 1) > 1e-3:
        raise InputError(f"{where}: the axes of the slices are not at right angles. Export the series anew.")
    places = np.array(positions)
    order = np.argsort(places @ normal, kind="stable")
    slices, places = tuple(series.slices[n] for n in order), places[order]
    _check_steps(slices, places @ normal, where)
    step = (places[-1] - places[0]) / (len(places) - 1)
    off = places - (places[0] + np.arange(len(places))[:, None] * step)
    if (worst := np.linalg.norm(off, axis=1).max()) > 0.1 * np.linalg.norm(step) + 0.05:
        raise InputError(
            f"{where}: the slices lie up to {worst:.2g} mm beside one straight line. Export the series anew, as one "
            "reconstruction."
        )
    axes = np.stack([row, column, normal / np.linalg.norm(normal)], 1)
    return _Layout(slices, axes, pixel[::-1], places[0], step)


def _check_in_common(series: Series, where: str) -> None:
    """Raises `InputError` for files of several patients, studies or frames of reference in one series.

    Missing tags say nothing, and neither do tags with another value in nearly each file, as some anonymisers leave
    them. Values are not told: messages end up in logs.
    """
    for tag, kinds in _IN_COMMON.items():
        files: dict[str, list[str]] = {}
        for one in series.slices:
            if value := one.words(tag):
                files.setdefault(value, []).append(one.path.name)
        if len(files) > 1 and 2 * len(files) <= len(series.slices):
            listed = "; ".join(f"{len(names)} as {names[0]}" for names in list(files.values())[:MOST_LISTED])
            raise InputError(
                f"{where}: {series.told} holds files of {len(files)} {kinds}, by {tag}: {listed}. Move those of each "
                "into a folder of its own, or export the series anew."
            )


def _other_steps(series: Series, layout: "_Layout", where: str) -> tuple[str, ...]:
    """What tags of the slices say against the step between their positions, which is taken, in words."""
    first, along = series.slices[0], float(np.linalg.norm(layout.step))
    across = float(layout.step @ layout.axes[:, 2])  # less than along the table where the gantry was tilted
    said, thickness = first.number("SpacingBetweenSlices"), first.number("SliceThickness")
    told = []
    if said and min(abs(abs(said) - mm) for mm in (along, across)) > max(_ROUNDED_MM, _SAME_STEP * across):
        told.append(
            f"SpacingBetweenSlices of {where} is {abs(said):.4g} mm, but the positions of its slices are {across:.4g} "
            "mm apart, which is taken: if bones look stretched, export the CT anew"
        )
    if thickness and thickness > 0 and across > _MOST_STEP * thickness + _ROUNDED_MM:
        told.append(
            f"the slices of {where} are {thickness:.4g} mm thick and {across:.4g} mm apart, so there are gaps: does "
            "the folder hold each of them, or every second or third?"
        )
    return tuple(told)


def _check_alike(series: Series, cosines: NDArray[np.float64], pixel: NDArray[np.float64], where: str) -> None:
    """Raises `InputError` if slices differ in size, spacing or orientation: a series of several reconstructions."""
    sizes = Counter((one.whole("Rows", 0), one.whole("Columns", 0)) for one in series.slices)
    if len(sizes) > 1:
        listed = ", ".join(f"{count} of {rows} × {columns}" for (rows, columns), count in sizes.most_common())
        raise InputError(f"{where}: {series.told} holds slices of several sizes ({listed}). Export one reconstruction.")
    for one in series.slices:
        turned, spaced = one.numbers("ImageOrientationPatient", 6), one.numbers("PixelSpacing", 2)
        if turned is None or spaced is None or abs(turned - cosines).max() > 1e-3 or abs(spaced - pixel).max() > 1e-3:
            raise InputError(
                f"{where}: {one.path.name} has another orientation or pixel spacing than {series.slices[0].path.name}. "
                "Export one reconstruction."
            )
    for name in ("RescaleSlope", "RescaleIntercept"):
        lacking = [one.path.name for one in series.slices if one.number(name) is None]
        if 0 < len(lacking) < len(series.slices):
            raise InputError(
                f"{where}: {len(lacking)} of {len(series.slices)} slices have no {name} ({lacking[0]}, …), so their "
                "values are not in HU. Export the series anew."
            )


def _check_steps(slices: Sequence[Slice], heights: NDArray[np.float64], where: str) -> None:
    """Raises `InputError` for slices that are doubled, missing or unevenly spaced."""
    steps = np.diff(heights)
    close = steps < _SAME_PLACE_MM
    if close.any():
        first = int(np.flatnonzero(close)[0])
        acquisitions = {one.header.get("AcquisitionNumber") for one in slices}
        phases = f" from {len(acquisitions)} acquisitions" if len(acquisitions) > 1 else ""
        raise InputError(
            f"{where}: {int(close.sum())} slices{phases} lie where another one lies (as {slices[first].path.name} and "
            f"{slices[first + 1].path.name}). Keep one reconstruction or phase."
        )
    usual = float(steps.min())
    gaps = steps > 1.5 * usual
    if gaps.any() and np.allclose(steps / usual, np.rint(steps / usual), atol=0.1):
        after = ", ".join(slices[n].path.name for n in np.flatnonzero(gaps)[:3])
        missing = int(np.rint(steps[gaps] / usual).sum() - gaps.sum())
        raise InputError(
            f"{where}: {missing} of {len(slices) + missing} slices are missing (after {after}), at steps of "
            f"{usual:.4g} mm. Copy the whole series."
        )
    if steps.max() > 1.1 * usual:
        raise InputError(
            f"{where}: the slices are {steps.min():.4g} to {steps.max():.4g} mm apart. Reconstruct or export the "
            "series with one step."
        )


def _straightened(image: sitk.Image, lean: NDArray[np.float64]) -> sitk.Image:
    """A volume whose slices are shifted by `lean` (3,) mm more, one after the other, on a rectangular grid."""
    size, spacing = np.array(image.GetSize()), np.array(image.GetSpacing())
    axes, origin = np.reshape(image.GetDirection(), (3, 3)), np.array(image.GetOrigin())
    shift = axes[:, :2].T @ lean / spacing[:2] * (size[2] - 1)  # of the last slice against the first, pixels
    low, high = np.floor(np.minimum(shift, 0)), np.ceil(np.maximum(shift, 0))
    grid = [int(n) for n in (*(size[:2] + high - low).astype(int), size[2])]
    start = origin + axes[:, :2] @ (low * spacing[:2])
    # where a point of the patient lies in the stored volume, whose slices all stand upright there
    sheared = np.eye(3) - np.outer(lean, axes[:, 2]) / spacing[2]
    upright = sitk.AffineTransform(sheared.ravel().tolist(), [0.0, 0.0, 0.0], origin.tolist())
    return sitk.Resample(
        image, grid, upright, sitk.sitkLinear, start.tolist(), spacing.tolist(), axes.ravel().tolist(), _AIR_HU
    )


def _multi_frame(path: Path) -> sitk.Image:
    """An enhanced CT: all slices as frames of one file. Raises `InputError`."""
    import highdicom  # half a second, and few CTs are of this kind

    try:  # what pydicom and highdicom raise for tags that lack or contradict one another, and for broken pixels
        # HU are what the rescale gives; a map of real-world values may tell iodine or density, and a presentation LUT
        # turns the values of MONOCHROME1 over
        volume = highdicom.imread(path).get_volume(
            dtype=np.float32, apply_real_world_transform=False, apply_presentation_lut=False
        )
    except (AttributeError, KeyError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: its frames cannot be read as one volume ({error}). Export the series with a file for each slice."
        ) from error
    return image_of(volume.array, volume.affine)
