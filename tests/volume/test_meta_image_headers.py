"""Headers of MetaImages that MetaIO crashes on never reach it."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from femoreg_torch.errors import InputError
from femoreg_torch.volume.itk import read_itk


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        (b"NDims = 3", b"NDims = -1", "NDims"),
        (b"NDims = 3", b"NDims = 2147483648", "NDims"),
        (b"NDims = 3", b"NDims = 4", "DimSize"),
        (b"DimSize = 7 8 9", b"DimSize = 7 8", "DimSize"),
    ],
)
def test_lists_are_as_long_as_the_dimensions_say(tmp_path: Path, was: bytes, becomes: bytes, says: str) -> None:
    path = tmp_path / "ct.mha"
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((9, 8, 7), np.int16)), str(path))
    content = path.read_bytes()
    assert read_itk(path).GetSize() == (7, 8, 9)
    assert was in content
    path.write_bytes(content.replace(was, becomes))
    with pytest.raises(InputError, match=f"ct\\.mha: `{says}` in its header"):
        read_itk(path)
