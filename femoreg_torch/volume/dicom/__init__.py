"""CT from DICOM: headers of files, the series of a folder, and one of them as a volume."""
