"""What headers of a procedure's images say of one another: six exposures, one of which is not what it is given as."""

import re
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from test_dicom_images import write

from femoreg_torch.fluoro import Exposure, Tags, other_patient, read_header, told_together
from femoreg_torch.volume import NOBODY, Patient

ANGLES = ((0.0, 0.0), (10.4, 2.0), (-15.0, -1.0))
BEGAN = datetime(2026, 1, 1, 23, 30)


def six() -> list[Exposure]:
    """Without and with the device, of three poses of the C-arm, over midnight."""
    return [
        Exposure(
            view,
            kind,
            f"{kind}{view + 1}.dcm",
            Tags(
                sdd_mm=1000.0 + view,
                patient=Patient("p", "simulated^hip"),
                instance=f"1.2.{view}.{kind}",
                arm_deg=(ANGLES[view][0] + (0.6 if kind == "device" else 0), ANGLES[view][1]),
                taken=BEGAN + timedelta(minutes=20 * view + (60 if kind == "device" else 0)),
            ),
        )
        for kind in ("anatomy", "device")
        for view in range(3)
    ]


def changed(number: int, **tags: object) -> list[str]:
    exposures = six()
    one = exposures[number]
    exposures[number] = replace(one, tags=replace(one.tags, **tags))  # type: ignore[arg-type]
    return told_together(exposures)


def test_nothing_is_told_of_images_of_one_procedure() -> None:
    assert told_together(six()) == []
    assert told_together([replace(one, tags=Tags()) for one in six()]) == []
    assert told_together([]) == []
    alike = [replace(one, tags=replace(one.tags, instance="1.2.3")) for one in six()]  # as anonymisers leave them
    assert told_together(alike) == []


@pytest.mark.parametrize(
    ("number", "tags", "told"),
    [
        (
            3,
            {"patient": Patient("q", "simulated^hip")},
            "device1.dcm: of another patient than anatomy1.dcm, by PatientID",
        ),
        (3, {"patient": Patient("", "other")}, "by PatientName in the headers"),
        (4, {"instance": "1.2.1.anatomy"}, "anatomy2.dcm, device2.dcm: one and the same exposure by SOPInstanceUID"),
        (4, {"arm_deg": (-15.0, -1.0)}, "view 2: device2.dcm was taken 25° from anatomy2.dcm,.*angles of view 3: are"),
        (4, {"arm_deg": (10.0, 30.0)}, "view 2: device2.dcm was taken 28° from anatomy2.dcm, .* of one pose.$"),
        (5, {"taken": BEGAN + timedelta(days=3)}, "device3.dcm: taken 72 hours after anatomy1.dcm"),
        (5, {"sdd_mm": 1100.0}, "device3.dcm: DistanceSourceToDetector is 1100 mm, but 1000 mm in anatomy1.dcm"),
    ],
)
def test_what_does_not_belong_together_is_told(number: int, tags: dict, told: str) -> None:
    found = changed(number, **tags)
    assert len(found) == 1
    assert re.search(told, found[0])


def test_both_of_two_images_that_were_exchanged_are_told() -> None:
    exposures = six()
    second, third = exposures[4], exposures[5]
    exposures[4:] = [replace(second, tags=third.tags), replace(third, tags=second.tags)]
    told = told_together(exposures)
    assert [("view 3" in one, "view 2" in one) for one in told] == [(True, True)] * 2


def test_frames_of_one_run_are_exposures_of_their_own() -> None:
    run = [Exposure(view, "anatomy", "run.dcm", Tags(instance="1.2.3"), (view,)) for view in range(3)]
    assert told_together(run) == []
    assert "one and the same" in told_together([*run, replace(run[0], view=4)])[0]


def test_images_of_another_patient_than_the_ct() -> None:
    assert other_patient(six(), NOBODY) == other_patient(six(), Patient("p", "of another spelling")) == []
    (told,) = other_patient(six()[:2], Patient("q"))
    assert told.startswith("anatomy1.dcm, anatomy2.dcm: of another patient than the CT, by PatientID")


def test_what_is_compared_is_read_from_the_header(tmp_path: Path) -> None:
    angles = {"PositionerPrimaryAngle": -15, "PositionerSecondaryAngle": 2.5}
    time = {"AcquisitionDate": "20260101", "AcquisitionTime": "233000.25"}
    read = read_header(write(tmp_path, PatientID="P 1 ", PatientName="Hip^Simulated^^", **angles, **time))
    assert (read.patient, read.instance) == (Patient("p 1", "hip^simulated"), "1.2.3")
    assert (read.arm_deg, read.taken) == ((-15.0, 2.5), BEGAN)
    bare = read_header(write(tmp_path, PositionerPrimaryAngle=-15, ContentDate="20260101"))
    assert (bare.patient, bare.arm_deg, bare.taken) == (NOBODY, None, None)
    assert read_header(write(tmp_path, PositionerMotion="DYNAMIC", **angles)).arm_deg is None
