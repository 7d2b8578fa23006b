"""Patients that are computed: bones, landmarks on them, and the CT that would be taken of them.

`procedural` draws a patient from a seed; `from_labels` and `around_surfaces` take the bones from a label map or from
closed surfaces and invent everything else.
"""

from sim.patient.procedural.patient import make_patient, make_scans
from sim.patient.scan import Patient
from sim.patient.writing import write_patient

__all__ = ["Patient", "make_patient", "make_scans", "write_patient"]
