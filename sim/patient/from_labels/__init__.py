"""Patients around the bones of a label map."""

from sim.patient.from_labels.patient import make_label_patient, write_label_patient

__all__ = ["make_label_patient", "write_label_patient"]
