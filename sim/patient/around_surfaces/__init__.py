"""Patients around closed surfaces of bones: shape and position of the bones are given, everything else is invented."""

from sim.patient.around_surfaces.scan import Options, patient_around
from sim.patient.around_surfaces.surfaces import BoneSurfaces, read_surfaces
from sim.patient.around_surfaces.writing import write_patient_around

__all__ = ["BoneSurfaces", "Options", "patient_around", "read_surfaces", "write_patient_around"]
