"""Fluoroscopic images: files, attenuation and coarser grids."""

from femoreg_torch.fluoro.intensity import attenuation_image, downsample
from femoreg_torch.fluoro.reading import check_matches, read_image, write_image

__all__ = ["attenuation_image", "check_matches", "downsample", "read_image", "write_image"]
