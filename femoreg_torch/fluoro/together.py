"""What the headers of a procedure's images say of one another: patient, exposure, angles of the C-arm, day, distance.

Nothing of this is refused. Files that were made anonymous may tell different patients and days, and mobile C-arms may
tell angles that nobody measured.
"""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta

from femoreg_torch.fluoro.dicom import Frames
from femoreg_torch.fluoro.tags import Tags, apart_deg
from femoreg_torch.volume.patient import Patient

_SAME_ARM_DEG = 1.5  # between both images of a view: two angles that were rounded to whole degrees, and half a degree
_ONE_PROCEDURE = timedelta(hours=12)
_SAME_DISTANCE = 0.01  # of a source distance: as `tags` asks it of header and case


@dataclass(frozen=True)
class Exposure:
    """An image of a view, from 0, that a DICOM file holds, of a kind, and what its header says."""

    view: int
    kind: str
    file: str
    tags: Tags
    frames: Frames | None = None


def told_together(exposures: Sequence[Exposure]) -> list[str]:
    """In words, where headers of a procedure's images contradict one another, or how they are paired in views.

    Tags that are missing say nothing.
    """
    return [
        *_patients(exposures),
        *_one_exposure(exposures),
        *_angles(exposures),
        *_days(exposures),
        *_distances(exposures),
    ]


def other_patient(exposures: Sequence[Exposure], ct: Patient) -> list[str]:
    """In words, that images are of another patient than the CT, by their headers."""
    found = [(one, tag) for one in exposures if (tag := one.tags.patient.other_than(ct)) is not None]
    if not found:
        return []
    return [
        f"{_files([one for one, _ in found])}: of another patient than the CT, by {found[0][1]} in the headers. Look "
        "whether files of two patients were mixed up; files that were made anonymous may differ so"
    ]


def _patients(exposures: Sequence[Exposure]) -> Iterator[str]:
    for one in exposures[1:]:
        if (tag := one.tags.patient.other_than(exposures[0].tags.patient)) is not None:
            yield (
                f"{one.file}: of another patient than {exposures[0].file}, by {tag} in the headers. Look whether files "
                "of two patients were mixed up; files that were made anonymous may differ so"
            )
            return


def _one_exposure(exposures: Sequence[Exposure]) -> Iterator[str]:
    """Files that were anonymised may all have one UID; that says nothing."""
    found: dict[Hashable, list[Exposure]] = {}
    for one in exposures:
        if one.tags.instance:
            found.setdefault((one.tags.instance, str(one.frames)), []).append(one)
    for same in found.values():
        if 1 < len(same) < len(exposures):
            yield f"{_files(same)}: one and the same exposure by SOPInstanceUID. Is each the image that it is given as?"


def _angles(exposures: Sequence[Exposure]) -> Iterator[str]:
    """The C-arm stands still between the images of a view."""
    first: dict[int, Exposure] = {}
    for one in exposures:
        if one.tags.arm_deg is not None:
            first.setdefault(one.view, one)
    for one in exposures:
        own = first.get(one.view)
        if own is None or _apart(one, own) <= _SAME_ARM_DEG:
            continue
        others = [other.view for other in first.values() if _apart(one, other) <= _SAME_ARM_DEG]
        like = f" It has the angles of view {others[0] + 1}: are images exchanged?" if others else ""
        yield (
            f"view {one.view + 1}: {one.file} was taken {_apart(one, own):.0f}° from {own.file}, by the C-arm's angles "
            f"in the headers, and all images of a view are to be of one pose.{like}"
        )


def _apart(one: Exposure, other: Exposure) -> float:
    """The greater difference of both angles, degrees; 0 where a header does not tell them."""
    if one.tags.arm_deg is None or other.tags.arm_deg is None:
        return 0.0
    return max(apart_deg(a, b) for a, b in zip(one.tags.arm_deg, other.tags.arm_deg, strict=True))


def _days(exposures: Sequence[Exposure]) -> Iterator[str]:
    taken = sorted((one.tags.taken, one.file) for one in exposures if one.tags.taken is not None)
    if taken and (between := taken[-1][0] - taken[0][0]) > _ONE_PROCEDURE:
        hours = between.total_seconds() / 3600
        yield (
            f"{taken[-1][1]}: taken {hours:.0f} hours after {taken[0][1]}, by their headers. All images are to be of "
            "one procedure"
        )


def _distances(exposures: Sequence[Exposure]) -> Iterator[str]:
    told = sorted((one.tags.sdd_mm, one.file) for one in exposures if one.tags.sdd_mm is not None)
    if told and told[-1][0] > (1 + _SAME_DISTANCE) * told[0][0]:
        yield (
            f"{told[-1][1]}: DistanceSourceToDetector is {told[-1][0]:g} mm, but {told[0][0]:g} mm in {told[0][1]}, "
            "and the case has one C-arm. Was the detector moved? Then their magnification differs"
        )


def _files(exposures: Sequence[Exposure]) -> str:
    return ", ".join(one.file for one in exposures)
