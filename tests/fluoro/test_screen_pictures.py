"""Pictures of a screen are read, with a warning; files of intensities are not called so."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import read_stored, settled_intensity

PIXELS = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 40), dtype=np.uint8), (0, 0), 4)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".png", ".bmp"])
@pytest.mark.parametrize("colour", [False, True])
def test_eight_bits_are_a_picture_of_a_screen(tmp_path: Path, suffix: str, colour: bool) -> None:
    path = tmp_path / f"view{suffix}"
    cv2.imwrite(str(path), np.repeat(PIXELS[..., None], 3, -1) if colour else PIXELS)
    read = read_stored(path)
    np.testing.assert_allclose(read.values.numpy(), PIXELS, atol=3)
    assert "picture of a screen" in read.remarks[0]


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_not(tmp_path: Path, suffix: str) -> None:
    cv2.imwrite(str(tmp_path / f"view{suffix}"), PIXELS.astype(np.uint16) * 200)
    assert read_stored(tmp_path / f"view{suffix}").remarks == ()


def test_what_looks_like_logarithms_is_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "view.tif"
    cv2.imwrite(str(path), (PIXELS / 30).astype(np.float32))
    read = read_stored(path)
    with pytest.raises(InputError, match=r"looks like logarithms already\. Say so in the view"):
        settled_intensity(None, read, "view.tif")
    assert settled_intensity("raw", read, "view.tif") == "raw"
