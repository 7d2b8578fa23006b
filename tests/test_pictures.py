"""Words on pictures."""

import numpy as np
import pytest

from femoreg_torch.pictures import put_words


@pytest.mark.parametrize("ground", [0, 255])
def test_words_are_read_on_black_and_on_white(ground: int) -> None:
    picture = np.full((40, 120, 3), ground, np.uint8)
    put_words(picture, "ASIS-l", (10, 25), 0.5, (255, 255, 255))
    white, black = (picture > 200).all(2), (picture < 55).all(2)
    written = slice(12, 30), slice(8, 60)
    assert white[written].sum() > 60
    assert black[written].sum() > 60
