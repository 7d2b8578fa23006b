"""Whom a DICOM file is of, as far as its header tells: enough to say that two files are of different patients."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Patient:
    """PatientID and PatientName as they are compared; empty where the header is silent."""

    number: str = ""
    name: str = ""

    def other_than(self, other: "Patient") -> str | None:
        """The tag by which two are different patients; None where nothing says so. Names count where a number lacks."""
        if self.number and other.number:
            return "PatientID" if self.number != other.number else None
        return "PatientName" if self.name and other.name and self.name != other.name else None


NOBODY = Patient()  # where a header is silent, or there is none


def compared_text(header: Any, tag: str) -> str:
    """The text of a tag (of a pydicom data set), in small letters and without the marks that end names."""
    return str(header.get(tag) or "").strip(" ^").casefold()


def patient_in(header: Any) -> Patient:
    """Whom a pydicom data set is of."""
    return Patient(compared_text(header, "PatientID"), compared_text(header, "PatientName"))
