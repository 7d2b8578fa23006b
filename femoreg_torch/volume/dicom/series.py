"""The series of a folder of DICOM files, and which of them is the CT."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.errors import InputError
from femoreg_torch.volume.dicom.headers import Slice, headers_in, is_dicom, slice_of
from femoreg_torch.volume.patient import NOBODY, Patient, patient_in

_VOLUMES = ("CT", "MR", "PT", "NM", "OT")  # modalities whose series may be volumes; others are images, reports, masks
MOST_LISTED = 12  # series in a message


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


def series_in(folder: Path) -> list[Series]:
    """All DICOM series in a folder and in the folders inside it, in order of their numbers.

    A file that stands there twice, by its SOP Instance UID and its place, counts once. Images without a Series Instance
    UID are taken for one series. A scout that bears the UID of the volume it was taken for is no part of it.
    """
    found: dict[str, dict[str, Slice]] = {}
    for one in headers_in(folder):
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


def choose_series(path: Path, wanted: str | None = None) -> Series:
    """The series that `path` stands for: the one volume in a folder, or that of a file, from the folder it lies in.

    `wanted` names one of several: its number, its UID, or a part of its description. Raises `InputError` that names
    them all if that leaves none or several.
    """
    folder = path if path.is_dir() else path.parent
    there = series_in(folder)
    own = str(slice_of(path).header.get("SeriesInstanceUID") or "") if path.is_file() else ""
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


def told_apart(series: Sequence[Series]) -> list[str]:
    """Several series in a few words each; with the UIDs of those that nothing else tells apart."""
    names = [(one.number, one.description) for one in series]
    alone = [any(name) and names.count(name) == 1 for name in names]
    return [one.told if known else f"{one.told} {one.uid}" for one, known in zip(series, alone, strict=True)]


def _listed(series: Sequence[Series]) -> str:
    told = told_apart(series)
    more = f" and {len(told) - MOST_LISTED} more" if len(told) > MOST_LISTED else ""
    return ", ".join(told[:MOST_LISTED]) + more
