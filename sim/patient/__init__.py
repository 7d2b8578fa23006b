"""A procedural patient: bones as swept shapes on a grid, soft tissue around them, landmarks known from the geometry."""

from sim.patient.scan import Patient, make_patient, make_scans

__all__ = ["Patient", "make_patient", "make_scans"]
