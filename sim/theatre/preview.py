"""One picture of all images of a procedure, to look at."""

from pathlib import Path

import numpy as np
import torch

from femoreg_torch.evaluation.overlay import Picture, monitor_picture
from femoreg_torch.fluoro import attenuation_image, downsample, find_shutter
from femoreg_torch.geometry import Camera
from femoreg_torch.pictures import write_picture
from sim.theatre.images import ViewImages

_PREVIEW_PX = 512  # width of one image, or a little more: the detector is averaged over whole blocks


def write_preview(path: Path, images: list[ViewImages], camera: Camera) -> None:
    """One picture of all images as a monitor shows them (bone dark): a column per view, anatomy above device.

    `camera` is that of the images. Where a shutter is seen, what it leaves sets the grey values, or bone would vanish
    beside its shade.
    """
    rows = [np.hstack([_shown(getattr(view, name), camera) for view in images]) for name in ("anatomy", "device")]
    write_picture(path, np.vstack(rows))


def _shown(raw: torch.Tensor, camera: Camera) -> Picture:
    factor = max(1, raw.shape[1] // _PREVIEW_PX)
    shutter = find_shutter(raw.float(), camera)
    field = None if shutter is None else downsample(shutter.field, factor) > 0.5
    return monitor_picture(downsample(attenuation_image(raw.float()), factor), field)
