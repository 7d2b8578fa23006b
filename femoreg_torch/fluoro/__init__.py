"""Fluoroscopic images: files, display, the exposed field, attenuation, distortion and coarser grids."""

from femoreg_torch.fluoro.collimation import Shutter, exposed_field, find_shutter, shades, without_penumbra
from femoreg_torch.fluoro.defects import without_defects
from femoreg_torch.fluoro.dicom import Frames, carm_settings, read_header
from femoreg_torch.fluoro.display import SOURCES, TURNS, Display, Source, nearest_source
from femoreg_torch.fluoro.distortion import Distortion, GridImage, find_distortion, find_grid_spots
from femoreg_torch.fluoro.exchanged import kinds_exchanged, rough_attenuation, shows_less, views_exchanged
from femoreg_torch.fluoro.field import Circle, Polygon, blank_lines
from femoreg_torch.fluoro.intensity import (
    attenuation_image,
    below_zero,
    binned,
    check_intensity,
    downsample,
    intensity_of,
    natural,
    raised,
)
from femoreg_torch.fluoro.reading import (
    StoredImage,
    check_matches,
    may_be_image,
    read_image,
    read_stored,
    settled_intensity,
    write_image,
)
from femoreg_torch.fluoro.saturation import saturated
from femoreg_torch.fluoro.tags import Tags, check_header, contradictions, nearest_side
from femoreg_torch.fluoro.together import Exposure, other_patient, told_together

__all__ = [
    "SOURCES",
    "TURNS",
    "Circle",
    "Display",
    "Distortion",
    "Exposure",
    "Frames",
    "GridImage",
    "Polygon",
    "Shutter",
    "Source",
    "StoredImage",
    "Tags",
    "attenuation_image",
    "below_zero",
    "binned",
    "blank_lines",
    "carm_settings",
    "check_header",
    "check_intensity",
    "check_matches",
    "contradictions",
    "downsample",
    "exposed_field",
    "find_distortion",
    "find_grid_spots",
    "find_shutter",
    "intensity_of",
    "kinds_exchanged",
    "may_be_image",
    "natural",
    "nearest_side",
    "nearest_source",
    "other_patient",
    "raised",
    "read_header",
    "read_image",
    "read_stored",
    "rough_attenuation",
    "saturated",
    "settled_intensity",
    "shades",
    "shows_less",
    "told_together",
    "views_exchanged",
    "without_defects",
    "without_penumbra",
    "write_image",
]
