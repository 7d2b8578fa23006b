"""Pictures into files, by OpenCV; what fails is told by the system, and nothing is printed beside."""

from pathlib import Path

import cv2
import numpy as np


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture, grey (H, W) or blue, green, red (H, W, 3), in the format of the name's suffix.

    It is encoded in memory: `cv2.imwrite` does not say why it failed, and libpng prints that it did. Raises `OSError`.
    """
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())
