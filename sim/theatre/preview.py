"""One picture of all images of a procedure, to look at."""

from pathlib import Path

import cv2
import numpy as np
import torch

from femoreg_torch.evaluation.overlay import Picture, monitor_picture
from femoreg_torch.fluoro import attenuation_image, downsample
from sim.theatre.images import ViewImages

_PREVIEW_PX = 512  # width of one image, or a little more: the detector is averaged over whole blocks


def write_preview(path: Path, images: list[ViewImages]) -> None:
    """One picture of all images as a monitor shows them (bone dark): a column per view, anatomy above device."""
    rows = [np.hstack([_shown(getattr(view, name)) for view in images]) for name in ("anatomy", "device")]
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise OSError(f"{path}: the preview could not be written.")


def _shown(raw: torch.Tensor) -> Picture:
    return monitor_picture(downsample(attenuation_image(raw.float()), max(1, raw.shape[1] // _PREVIEW_PX)))
