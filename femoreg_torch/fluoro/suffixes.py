"""Endings of the names of fluoroscopic images. Files of any other name are read as DICOM."""

ITK_SUFFIXES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
SCREEN_SUFFIXES = (".jpg", ".jpeg", ".bmp")  # what nobody stores intensities in
