"""Reliability of confidences that were drawn to be right, and of others that are too high."""

from pathlib import Path

import numpy as np
import pytest

from femoreg_torch.anatomy import HIP
from training.calibration import calibration_error, draw_reliability, reliability
from training.measure import Reading


def readings(exponent: float) -> list[Reading]:
    """20 000 landmarks right with probability p, stated as p to the power of `exponent`.

    Half of those that are wrong are not in the image, the others are 20 mm off.
    """
    rng = np.random.default_rng(1)
    p = rng.uniform(0, 1, 20_000)
    right, absent = rng.uniform(size=p.size) < p, rng.uniform(size=p.size) < 0.5
    error, visible = np.where(right | absent, 3.0, 20.0), right | ~absent
    nothing = np.zeros((len(HIP.bones), 2))
    return [Reading("one", error, p > 0.5, visible, p**exponent, nothing, False, False, np.full(3, np.nan))]


def test_calibrated_confidences() -> None:
    stated, true, number = reliability(readings(1.0))
    np.testing.assert_allclose(stated, true, atol=0.04)
    assert number.sum() == 20_000
    assert calibration_error(readings(1.0)) < 0.015


def test_confidences_that_are_too_high() -> None:
    """Stated √p where p is true: off by ∫ (√p − p) dp = 1/6 in the mean."""
    assert calibration_error(readings(0.5)) == pytest.approx(1 / 6, abs=0.01)


def test_the_picture(tmp_path: Path) -> None:
    draw_reliability(readings(1.0), tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 5000
