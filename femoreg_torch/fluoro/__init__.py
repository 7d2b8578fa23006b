"""Fluoroscopic images: files, the exposed field, attenuation and coarser grids."""

from femoreg_torch.fluoro.collimation import Shutter, exposed_field, find_shutter, without_penumbra
from femoreg_torch.fluoro.field import Circle, Polygon
from femoreg_torch.fluoro.intensity import attenuation_image, binned, downsample
from femoreg_torch.fluoro.reading import check_matches, read_image, write_image

__all__ = [
    "Circle",
    "Polygon",
    "Shutter",
    "attenuation_image",
    "binned",
    "check_matches",
    "downsample",
    "exposed_field",
    "find_shutter",
    "read_image",
    "without_penumbra",
    "write_image",
]
