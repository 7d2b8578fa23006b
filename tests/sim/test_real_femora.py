"""A femur cut out of a real CT's grey values, here of solids whose truth is known."""

from pathlib import Path

import numpy as np
import pytest

from femoreg_torch.errors import InputError
from sim.patient.real_femora import RealFemur, cut_out_femur, write_real_femur

SPACING = np.array([1.0, 1.0, 3.0])
KNOWN = RealFemur(
    "none.nii.gz", "left", (30.0, 30.0, 14.0), 15.0, (((0, 999), (0, 999), (16, 999)), ((0, 20), (0, 999), (0, 999)))
)


def test_femur_and_pelvis_are_told_apart_and_marrow_is_filled() -> None:
    x, y, z = np.ogrid[:80, :60, :22]
    head = (x - 30) ** 2 + (y - 30) ** 2 + (3.0 * (z - 14)) ** 2 <= 15**2
    shaft = (x - 60) ** 2 + (y - 30) ** 2 <= 12**2
    neck = (abs(y - 30) < 9) & (x >= 30) & (x <= 60) & (z >= 8) & (z < 14)
    femur = head | (shaft & (z < 15)) | neck
    socket = ((x - 30) ** 2 + (y - 30) ** 2 + (3.0 * (z - 14)) ** 2 > 17**2) & (
        ((x < 20) & (z > 6)) | ((z > 17) & (x < 45))
    )
    hu = np.where(femur | socket, 700.0, 40.0)
    hu = np.where(((x - 60) ** 2 + (y - 30) ** 2 <= 7**2) & (z < 12), -60.0, hu)  # marrow
    found = cut_out_femur(hu, SPACING, KNOWN)
    overlap = 2 * (found & femur).sum() / (found.sum() + femur.sum())
    assert overlap > 0.97
    assert not (found & socket).any()
    assert found[60, 30, 5]  # marrow belongs to it


def test_a_ct_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Set FEMOREG_DATA"):
        write_real_femur("sts_044", tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
