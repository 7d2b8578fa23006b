"""Pictures into files, and words onto pictures, by OpenCV."""

import itertools
from pathlib import Path

import cv2
import numpy as np


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture, grey (H, W) or blue, green, red (H, W, 3), in the format of the name's suffix.

    It is encoded in memory: `cv2.imwrite` does not say why it failed, and libpng prints that it did. Raises `OSError`,
    which tells why.
    """
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def put_words(
    picture: np.ndarray, words: str, place: tuple[int, int], size: float, colour: tuple[int, int, int], line: int = 1
) -> None:
    """Write words onto a picture from a place (column, row) on, with a dark rim: they are read on white as well.

    The rim is the same words about the place: bolder ones would be wider, and so would not lie under these.
    """
    font = cv2.FONT_HERSHEY_SIMPLEX
    for right, down in itertools.product((-line, 0, line), repeat=2):
        beside = place[0] + right, place[1] + down
        cv2.putText(picture, words, beside, font, size, (0, 0, 0), line, cv2.LINE_AA)
    cv2.putText(picture, words, place, font, size, colour, line, cv2.LINE_AA)
