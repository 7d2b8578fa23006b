"""One picture of all images of a procedure, to look at."""

from pathlib import Path

import cv2
import numpy as np
import torch

from sim.theatre.images import ViewImages

_PREVIEW_PX = 512


def write_preview(path: Path, images: list[ViewImages]) -> None:
    """One picture of all images as a monitor shows them (bone dark): a column per view, anatomy above device."""
    rows = [np.hstack([_shown(getattr(view, name)) for view in images]) for name in ("anatomy", "device")]
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise OSError(f"{path}: the preview could not be written.")


def _shown(raw: torch.Tensor) -> np.ndarray:
    """An 8-bit picture of a raw image (H, W): small, logarithmic, windowed to what lies behind the patient."""
    small = cv2.resize(raw.numpy(), (_PREVIEW_PX, _PREVIEW_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = np.log(small.clip(1))
    low, high = np.percentile(grey[grey < grey.max() - 2], [0.5, 95])
    return ((grey - low) / max(high - low, 1e-6) * 255).clip(0, 255).astype(np.uint8)
