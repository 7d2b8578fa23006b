"""What the header of a DICOM image says of camera, display and grey values (DICOM PS3.3), and where a case differs.

Angles (C.8.7.5): the primary angle tells where the detector stands about the patient: 0° in front, +90° at the
patient's left, ±180° behind. The view position tells the way of the beam: AP from front to back. The patient's
orientation (C.7.6.1.1.1) names where rows and columns of the picture lead. Pixel spacing at the detector is the imager
pixel spacing (0018,1164); (0028,0030) may be scaled to any plane in the patient and says nothing here.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro.display import Display, Source
from femoreg_torch.fluoro.field import Circle, Overlap, Polygon
from femoreg_torch.geometry import Camera, Uncertainty
from femoreg_torch.volume.patient import NOBODY, Patient, patient_in

_NEAR_DEG = 75.0  # of a source from the middle of its side: half an orbit search, and a patient who lies askew
_VIEWS = {"AP": 0.0, "PA": 180.0}
_SIDES: dict[Source, float] = {"anterior": 0.0, "left": 90.0, "posterior": 180.0, "right": -90.0}
_LEAST_PERCENT = 1.0  # by which lengths differ before they contradict: headers are rounded, and distances nominal
_DEVIATIONS = 3.0  # the same, in those of the file


@dataclass(frozen=True)
class Tags:
    """What a header says; None where it is silent."""

    modality: str = ""
    shape: tuple[int, int] | None = None
    sdd_mm: float | None = None
    pixel_mm: tuple[float, float] | None = None  # row spacing, column spacing, on the detector
    principal_point_px: tuple[float, float] | None = None  # where the middle of the detector lies in the picture
    source_deg: float | None = None  # where the source stands about the patient, from the front to the patient's left
    orientation: tuple[str, str] | None = None  # where rows, and columns, of the picture lead: L, R, A, P, H or F
    field: Circle | Polygon | Overlap | None = None  # what shutters and collimators leave
    flipped: bool | None = None  # whether the picture is a mirror image of what the detector read
    patient: Patient = NOBODY
    instance: str = ""  # SOPInstanceUID
    arm_deg: tuple[float, float] | None = None  # primary and secondary angle of an arm that stood still
    taken: datetime | None = None

    def display(self, source: Source) -> Display | None:
        """How the picture shows a patient whose source stands on that side, if the orientation tells it."""
        if self.orientation is None:
            return None
        for mirrored in (False, True):
            for turned in (0, 90, 180, 270):
                display = Display(source, mirrored, turned)
                if _directions(display) == self.orientation:
                    return display
        return None  # of a view along the patient, say


def _directions(display: Display) -> tuple[str, str]:
    """Where rows and columns of a picture lead."""
    right = "L" if display.source in ("anterior", "posterior") else "P"
    opposite = {"L": "R", "R": "L", "P": "A", "A": "P", "F": "H", "H": "F"}
    row, column = (opposite[right] if display.mirrored else right), "F"
    for _ in range(display.turned_deg // 90):  # clockwise: what led down leads left
        row, column = opposite[column], row
    return row, column


def read_tags(dataset: Any) -> Tags:
    """What the header of a pydicom data set says. Raises `InputError` for a value that cannot be."""
    rows, columns = dataset.get("Rows"), dataset.get("Columns")
    shape = (int(rows), int(columns)) if rows and columns else None
    pixel = _numbers(dataset, "ImagerPixelSpacing", 2)
    sdd = _numbers(dataset, "DistanceSourceToDetector", 1)
    if sdd == [0.0]:
        sdd = None  # as some write what they do not know
    for name, value in (("ImagerPixelSpacing", pixel), ("DistanceSourceToDetector", sdd)):
        if value is not None and min(value) <= 0:
            raise InputError(f"DICOM tag {name}: a positive number was expected, found {min(value):g}.")
    return Tags(
        modality=str(dataset.get("Modality") or ""),
        shape=shape,
        sdd_mm=None if sdd is None else sdd[0],
        pixel_mm=None if pixel is None else (pixel[0], pixel[1]),
        principal_point_px=_middle_of_detector(dataset, shape, pixel),
        source_deg=_source(dataset),
        orientation=_orientation(dataset),
        field=_field(dataset, shape),
        flipped={"YES": True, "NO": False}.get(str(find_value(dataset, "FieldOfViewHorizontalFlip"))),
        patient=patient_in(dataset),
        instance=str(dataset.get("SOPInstanceUID") or ""),
        arm_deg=_arm(dataset),
        taken=_taken(dataset),
    )


def find_value(dataset: Any, keyword: str) -> Any:
    """A value at the top, or, in an enhanced image, in a group that all frames share or of the first frame."""
    value = dataset.get(keyword)
    if value is not None:
        return value
    for groups in ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"):
        for item in (dataset.get(groups) or [])[:1]:
            if (value := value_in(item, keyword)) is not None:
                return value
    return None


def value_in(group: Any, keyword: str) -> Any:
    """A value of one item of functional groups, its own or one of its sequences', or None."""
    for element in group:
        if element.keyword == keyword:
            return element.value
        for inner in element.value if element.VR == "SQ" else ():
            if inner.get(keyword) is not None:
                return inner.get(keyword)
    return None


def _numbers(dataset: Any, keyword: str, count: int) -> list[float] | None:
    """So many finite numbers, or None where the tag is absent or empty."""
    value = find_value(dataset, keyword)
    if value is None or value == "":
        return None
    try:
        numbers = [float(v) for v in np.atleast_1d(np.asarray(value, dtype=float))]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"DICOM tag {keyword}: {count} finite number(s) expected, found {str(value)[:60]!r}.")
    return numbers


def _taken(dataset: Any) -> datetime | None:
    """When an image was taken, to the second."""
    whole = str(dataset.get("AcquisitionDateTime") or "")
    parts = (f"{dataset.get(f'{of}Date') or ''}{dataset.get(f'{of}Time') or ''}" for of in ("Acquisition", "Content"))
    for text in (whole, *parts):
        with suppress(ValueError):  # of a day without a time, or of something else
            return datetime.strptime(text[:14], "%Y%m%d%H%M%S")  # that of the C-arm's own clock
    return None


def _moved(dataset: Any) -> bool:
    """Whether the arm moved during a run, and the header does not tell its angles of each frame."""
    return dataset.get("PositionerMotion") == "DYNAMIC" and not dataset.get("PerFrameFunctionalGroupsSequence")


def _arm(dataset: Any) -> tuple[float, float] | None:
    """Primary and secondary angle of the positioner, degrees."""
    if _moved(dataset):
        return None
    for of in ("Positioner", "PositionerIsocenter"):
        angles = [_numbers(dataset, f"{of}{which}Angle", 1) for which in ("Primary", "Secondary")]
        if angles[0] is not None and angles[1] is not None:
            return angles[0][0], angles[1][0]
    return None


def _source(dataset: Any) -> float | None:
    """Where the source stands about the patient, degrees: from the positioner's angle, or from the view's name.

    Of a run during which the arm moved these tell where it began, unless they are told of each frame.
    """
    if _moved(dataset):
        return None
    primary = _numbers(dataset, "PositionerPrimaryAngle", 1) or _numbers(dataset, "PositionerIsocenterPrimaryAngle", 1)
    if primary is None:
        return _VIEWS.get(str(find_value(dataset, "ViewPosition")))
    return primary[0] + 180  # opposite to the detector


def _orientation(dataset: Any) -> tuple[str, str] | None:
    """Where rows and columns lead, by the first letter of each, which is the main direction."""
    value = dataset.get("PatientOrientation")
    if not value or len(value) != 2 or not all(str(v)[:1] in tuple("LRAPHF") for v in value):
        return None
    return str(value[0])[0], str(value[1])[0]


def _middle_of_detector(
    dataset: Any, shape: tuple[int, int] | None, pixel: list[float] | None
) -> tuple[float, float] | None:
    """Where the middle of the detector lies in the picture, (column, row).

    The origin of the field of view (0018,7030) counts physical pixels of the detector, row then column, before the
    field was turned clockwise (0018,7032) and mirrored (0018,7034).
    """
    origin, element = _numbers(dataset, "FieldOfViewOrigin", 2), _numbers(dataset, "DetectorElementSpacing", 2)
    active = _numbers(dataset, "DetectorActiveDimensions", 2)
    if origin is None or element is None or active is None or shape is None or pixel is None:
        return None
    quarters = round((_numbers(dataset, "FieldOfViewRotation", 1) or [0.0])[0] / 90) % 4
    mirrored = find_value(dataset, "FieldOfViewHorizontalFlip") == "YES"
    extent = [n * mm for n, mm in zip(shape, pixel, strict=True)]  # of the field, mm: rows, columns
    on_detector = extent[::-1] if quarters % 2 else extent
    down, right = (
        a / 2 - (o * e + length / 2) for a, o, e, length in zip(active, origin, element, on_detector, strict=True)
    )
    for _ in range(quarters):  # clockwise: what lay above lies on the right
        down, right = right, -down
    right = -right if mirrored else right
    return (shape[1] - 1) / 2 + right / pixel[1], (shape[0] - 1) / 2 + down / pixel[0]


def _field(dataset: Any, shape: tuple[int, int] | None) -> Circle | Polygon | Overlap | None:
    """What all that a header tells leaves: a round display shutter, say, and the blades of a collimator within.

    A shape that leaves nothing, as edges of 0 in place of unknown ones do, is passed over.
    """
    told = (*_shapes(dataset, "Shutter"), *_shapes(dataset, "Collimator"))
    shapes = tuple(one for one in told if shape is None or one.exposed(shape).any())
    return Overlap(shapes) if len(shapes) > 1 else next(iter(shapes), None)


def _shapes(dataset: Any, kind: str) -> Iterator[Circle | Polygon]:
    """The shapes of a display shutter or a collimator, which lie over one another (C.7.6.11, C.8.7.3).

    Headers count pixels from 1, row before column.
    """
    shapes = dataset.get(f"{kind}Shape")
    shapes = [shapes] if isinstance(shapes, str) else list(shapes or ())
    if "CIRCULAR" in shapes:
        centre, radius = (
            _numbers(dataset, f"CenterOfCircular{kind}", 2),
            _numbers(dataset, f"RadiusOfCircular{kind}", 1),
        )
        if centre is not None and radius is not None and radius[0] > 0:
            yield Circle((centre[1] - 1, centre[0] - 1), radius[0])
    if "RECTANGULAR" in shapes:
        edges = [
            _numbers(dataset, f"{kind}{edge}Edge", 1)
            for edge in ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
        ]
        if all(edge is not None for edge in edges):
            left, right, upper, lower = (edge[0] - 1 for edge in edges if edge is not None)
            yield Polygon(((left, upper), (right, upper), (right, lower), (left, lower)))
    if "POLYGONAL" in shapes and (value := dataset.get(f"VerticesOfThePolygonal{kind}")) is not None:
        numbers = [float(v) for v in value]
        if len(numbers) >= 6 and len(numbers) % 2 == 0:
            corners = zip(numbers[1::2], numbers[::2], strict=True)
            yield Polygon(tuple((column - 1, row - 1) for column, row in corners))


def contradictions(tags: Tags, camera: Camera, display: Display, uncertainty: Uncertainty | None) -> list[str]:
    """Where a header contradicts what a case says of its pictures: their camera and display. In words; empty: nowhere.

    Lengths contradict where they differ by more than 1 %, or than three of the deviations that the C-arm's file tells.
    Side and orientation are not looked at where the display says that the header's mean nothing.
    """
    shown = [] if display.ignore_header else [*_other_side(tags, display), *_other_orientation(tags, display)]
    return [*_other_camera(tags, camera, uncertainty), *shown]


def check_header(
    tags: Tags | None, camera: Camera, display: Display, uncertainty: Uncertainty | None, where: str
) -> None:
    """Raises `InputError` that starts with `where` and tells all `contradictions`; nothing without a header."""
    if tags is not None and (wrong := contradictions(tags, camera, display, uncertainty)):
        raise InputError(f"{where}, {'; '.join(wrong)}.")


def _other_camera(tags: Tags, camera: Camera, uncertainty: Uncertainty | None) -> Iterator[str]:
    told = Uncertainty(sdd_percent=0.0) if uncertainty is None else uncertainty
    if tags.sdd_mm is not None:
        off = 100 * abs(tags.sdd_mm / camera.sdd_mm - 1)
        if off > max(_LEAST_PERCENT, _DEVIATIONS * told.sdd_percent):
            yield (
                f"DistanceSourceToDetector is {tags.sdd_mm:g} mm, but the C-arm has sdd_mm {camera.sdd_mm:g}. Correct "
                "`carm:`, or tell there how uncertain it is (uncertainty: {sdd_percent: …})"
            )
    if tags.pixel_mm is not None:
        off = 100 * max(abs(a / b - 1) for a, b in zip(tags.pixel_mm, camera.pixel_mm, strict=True))
        if off > _LEAST_PERCENT:
            yield (
                f"ImagerPixelSpacing (row, column) is {tags.pixel_mm[0]:g}, {tags.pixel_mm[1]:g} mm, but the C-arm has "
                f"pixel_mm {camera.pixel_mm[0]:g}, {camera.pixel_mm[1]:g}. Correct `carm:`"
            )
    if tags.principal_point_px is not None and tags.shape == camera.shape:
        (column, row), here = tags.principal_point_px, camera.principal_point_px
        mm = max(abs(column - here[0]) * camera.pixel_mm[1], abs(row - here[1]) * camera.pixel_mm[0])
        if mm > _DEVIATIONS * told.principal_point_mm:
            yield (
                f"FieldOfViewOrigin puts the middle of the detector {mm:.0f} mm from the C-arm's principal point. "
                f"Write `principal_point_px: [{column:.1f}, {row:.1f}]` under `carm:`"
            )


def _other_side(tags: Tags, display: Display) -> Iterator[str]:
    if tags.source_deg is not None and apart_deg(tags.source_deg, _SIDES[display.source]) > _NEAR_DEG:
        side = nearest_side(tags.source_deg)
        has = "takes it for anterior, as nothing is said" if display == Display() else f"says {display.source}"
        yield (
            f"PositionerPrimaryAngle or ViewPosition put the source on the patient's {side} side, but the case {has}. "
            f"Write `display: {{source: {side}}}`{_unless(display)}"
        )


def _other_orientation(tags: Tags, display: Display) -> Iterator[str]:
    told = tags.display(display.source)
    if told is not None and tags.orientation is not None and told != display:
        yield (
            f"PatientOrientation {tags.orientation[0]}, {tags.orientation[1]} does not fit the display of the case. "
            f"Write `display: {{source: {told.source}, mirrored: {str(told.mirrored).lower()}, "
            f"turned: {told.turned_deg}}}`{_unless(display)}"
        )


def _unless(display: Display) -> str:
    """What to write if the header is wrong."""
    said = {"source": display.source, "mirrored": display.mirrored, "turned": display.turned_deg}
    words = [f"{key}: {str(value).lower()}" for key, value in said.items() if key == "source" or value]
    return f", or, if the header's value means nothing, `display: {{{', '.join(words)}, ignore_header: true}}`"


def nearest_side(source_deg: float) -> Source:
    """The side of the patient that a source stands on, by its angle from the front to the patient's left."""
    return min(_SIDES, key=lambda name: apart_deg(source_deg, _SIDES[name]))


def apart_deg(a_deg: float, b_deg: float) -> float:
    """The angle between two directions, degrees."""
    return abs((a_deg - b_deg + 180) % 360 - 180)
