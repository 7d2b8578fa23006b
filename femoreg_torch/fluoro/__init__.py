"""Fluoroscopic images: files, display, the exposed field, attenuation, distortion and coarser grids."""

from femoreg_torch.fluoro.collimation import Shutter, exposed_field, find_shutter, without_penumbra
from femoreg_torch.fluoro.dicom import Frames, carm_settings
from femoreg_torch.fluoro.display import SOURCES, TURNS, Display, Source
from femoreg_torch.fluoro.distortion import Distortion, GridImage, find_distortion, find_grid_spots
from femoreg_torch.fluoro.field import Circle, Polygon
from femoreg_torch.fluoro.intensity import attenuation_image, binned, downsample
from femoreg_torch.fluoro.reading import (
    StoredImage,
    check_matches,
    read_image,
    read_stored,
    settled_intensity,
    write_image,
)
from femoreg_torch.fluoro.tags import Tags, contradictions, side_remarks

__all__ = [
    "SOURCES",
    "TURNS",
    "Circle",
    "Display",
    "Distortion",
    "Frames",
    "GridImage",
    "Polygon",
    "Shutter",
    "Source",
    "StoredImage",
    "Tags",
    "attenuation_image",
    "binned",
    "carm_settings",
    "check_matches",
    "contradictions",
    "downsample",
    "exposed_field",
    "find_distortion",
    "find_grid_spots",
    "find_shutter",
    "read_image",
    "read_stored",
    "settled_intensity",
    "side_remarks",
    "without_penumbra",
    "write_image",
]
