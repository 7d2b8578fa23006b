"""CT from DICOM: the series of a folder, and one of them as a volume with its true geometry.

GDCM, in SimpleITK, decodes the pixels, compressed ones as well, and applies each slice's rescale. Where the slices lie
is read here, from Image Position and Image Orientation (DICOM PS3.3, C.7.6.2), since ITK's reader of series passes over
missing slices, and over the shear of a tilted gantry.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from femoreg_torch.arrays import opened
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.volume.patient import NOBODY, Patient, compared_text, patient_in

_TAGS = (
    "SOPInstanceUID", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription", "Modality", "ImageType", "Rows",
    "Columns", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "NumberOfFrames", "AcquisitionNumber",
    "RescaleSlope", "RescaleIntercept", "PhotometricInterpretation", "BitsStored", "HighBit", "PatientID",
    "PatientName", "StudyInstanceUID", "FrameOfReferenceUID", "SliceThickness", "SpacingBetweenSlices",
)  # fmt: skip
# What all files of a series have in common (DICOM PS3.3, A.1.2), and what they are of by it.
_IN_COMMON = {
    "PatientID": "patients",
    "PatientName": "patients",
    "StudyInstanceUID": "studies",
    "FrameOfReferenceUID": "frames of reference",
}
_VOLUMES = ("CT", "MR", "PT", "NM", "OT")  # modalities whose series may be volumes; others are images, reports, masks
_DEFLATED = "1.2.840.10008.1.2.1.99"  # transfer syntax
_KINDS_OF_PIXELS = (b"OB", b"OW", b"OF", b"OD", b"UN")  # value representations of their element
_UNDEFINED = 0xFFFFFFFF  # length of compressed pixels
_AIR_HU = -1024.0  # what lies outside the slices of a tilted gantry
_NOT_DICOM = {".gz", ".nii", ".nrrd", ".mha", ".mhd", ".json", ".txt", ".png", ".jpg", ".tif", ".tiff", ".zip", ".stl"}
_MOST_LISTED = 12  # series in a message
_SAME_PLACE_MM = 0.01  # slices that are closer are one
_SHEAR_MM = 0.3  # of the last slice against the first: what rounding of positions and axes may make of it
_ROUNDED_MM, _SAME_STEP = 0.03, 0.02  # of the step that a header tells: 0.625 mm may be written as 0.6
_MOST_STEP = 1.25  # in thicknesses of a slice: those of a reconstruction without gaps touch or overlap


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


@dataclass(frozen=True)
class Series:
    """The files of one DICOM series."""

    uid: str
    slices: tuple[Slice, ...]
    number: str = ""
    description: str = ""
    modality: str = ""

    @property
    def told(self) -> str:
        """The series in a few words."""
        named = f" “{self.description}”" if self.description else ""
        return f"series {self.number or '?'}{named} ({self.modality or 'no modality'}, {len(self.slices)} files)"

    @property
    def may_be_volume(self) -> bool:
        """Whether it may be a CT: several slices, or one file of several frames, and no scout.

        Of a series that tells no modality, as some anonymisers leave it, slices with a place in the patient are taken.
        """
        first = self.slices[0]
        frames = first.whole("NumberOfFrames", 1)
        meant = self.modality.upper() in _VOLUMES or (not self.modality and "ImagePositionPatient" in first.header)
        return meant and not first.is_scout and (len(self.slices) > 1 or frames > 1)


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM: by its preamble, or, without one, by a first element of the group 0002 or 0008."""
    if not path.is_file() or path.suffix.lower() in _NOT_DICOM:
        return False
    with opened(path) as file:
        head = file.read(132)
    bare = len(head) == 132 and head[:2] in (b"\x02\x00", b"\x08\x00") and head[3:4] == b"\x00"
    return head[128:] == b"DICM" or bare


def series_in(folder: Path) -> list[Series]:
    """All DICOM series in a folder and in the folders inside it, in order of their numbers.

    A file that stands there twice, by its SOP Instance UID and its place, counts once. Images without a Series Instance
    UID are taken for one series. A scout that bears the UID of the volume it was taken for is no part of it.
    """
    found: dict[str, dict[str, Slice]] = {}
    for one in _headers(folder):
        uid = str(one.header.get("SeriesInstanceUID") or "")
        if uid or "Rows" in one.header:
            name = one.header.get("SOPInstanceUID") or one.path
            found.setdefault(uid, {}).setdefault(f"{name} {one.header.get('ImagePositionPatient')}", one)
    series = []
    for uid, files in found.items():
        slices = [one for one in files.values() if not one.is_scout] or list(files.values())
        first = slices[0].header
        words = (str(first.get(tag) or "").strip() for tag in ("SeriesNumber", "SeriesDescription", "Modality"))
        number, description, modality = words
        series.append(Series(uid, tuple(slices), number, description, modality))
    return sorted(series, key=lambda one: (not one.number.isdecimal(), one.number.zfill(9), one.uid))


def _headers(folder: Path) -> Iterator[Slice]:
    for path in sorted(folder.rglob("*")):
        if path.name.upper() != "DICOMDIR" and is_dicom(path):
            yield _slice(path)


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


def _slice(path: Path) -> Slice:
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


def choose_series(path: Path, wanted: str | None = None) -> Series:
    """The series that `path` stands for: the one volume in a folder, or that of a file, from the folder it lies in.

    `wanted` names one of several: its number, its UID, or a part of its description. Raises `InputError` that names
    them all if that leaves none or several.
    """
    folder = path if path.is_dir() else path.parent
    there = series_in(folder)
    own = str(_slice(path).header.get("SeriesInstanceUID") or "") if path.is_file() else ""
    if not there or (path.is_file() and own not in [one.uid for one in there]):
        raise InputError(f"{path}: holds no DICOM series. Give the folder of the slices, or a NIfTI, NRRD or MHA file.")
    if path.is_file():
        return next(one for one in there if one.uid == own)
    if wanted is not None:
        exact = [one for one in there if wanted in (one.number, one.uid)]
        chosen = exact or [one for one in there if wanted.lower() in one.description.lower()]
    else:
        chosen = [one for one in there if one.may_be_volume]
    if len(chosen) == 1:
        return chosen[0]
    alone = not chosen and len(there) > 2 and all(one.modality in _VOLUMES and len(one.slices) == 1 for one in there)
    if alone and wanted is None:
        raise InputError(
            f"{folder}: each of its {len(there)} DICOM files has a SeriesInstanceUID of its own, so they make no "
            "series. Export or anonymise them anew, with one UID for all."
        )
    listed = _listed(chosen or there)
    if wanted is not None:
        how = f"{len(chosen)} of its series are {wanted!r}" if chosen else f"none of its series is {wanted!r}"
        raise InputError(f"{folder}: {how}; there are: {listed}. Give one's number, its UID or a part of its name.")
    if not chosen:
        raise InputError(f"{folder}: none of its DICOM series is a volume; there are: {listed}. Choose another folder.")
    patients = {one.slices[0].words("PatientID") for one in chosen} - {""}
    several = f" of {len(patients)} patients (PatientID)" if len(patients) > 1 else ""
    raise InputError(
        f"{folder}: holds {len(chosen)} DICOM series{several}, one was expected: {listed}. Choose one: by its number, "
        "its UID or a part of its name with `--series`, or by the path of one of its files in case.yaml."
    )


def patient_of(path: Path, wanted: str | None = None) -> Patient:
    """Whom the DICOM series that `choose_series` takes is of; of a file of another format nothing is known."""
    if not (path.is_dir() or is_dicom(path)):
        return NOBODY
    return patient_in(choose_series(path, wanted).slices[0].header)


def _listed(series: Sequence[Series]) -> str:
    """The series in a few words each; with the UIDs of those that nothing else tells apart."""
    names = [(one.number, one.description) for one in series]
    alone = [any(name) and names.count(name) == 1 for name in names]
    told = [one.told if known else f"{one.told} {one.uid}" for one, known in zip(series, alone, strict=True)]
    more = f" and {len(told) - _MOST_LISTED} more" if len(told) > _MOST_LISTED else ""
    return ", ".join(told[:_MOST_LISTED]) + more


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
            listed = "; ".join(f"{len(names)} as {names[0]}" for names in list(files.values())[:_MOST_LISTED])
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


def image_of(array: NDArray[Any], lps_from_index: NDArray[np.float64]) -> sitk.Image:
    """A volume of highdicom, whose `array` is indexed as the columns of its affine are, as an image of SimpleITK."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    spacing = np.linalg.norm(lps_from_index[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps_from_index[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps_from_index[:3, 3].tolist())
    return image
