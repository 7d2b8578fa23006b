"""Reliability of confidences that were drawn to be right, and of others that boast."""

from pathlib import Path

import numpy as np
import pytest

from training.calibration import calibration_error, draw_reliability, negative_log_likelihood, reliability


def draws(exponent: float) -> tuple[np.ndarray, np.ndarray]:
    """20 000 landmarks right with probability p, stated as p to the power of `exponent`."""
    rng = np.random.default_rng(1)
    p = rng.uniform(0, 1, 20_000)
    return p**exponent, rng.uniform(size=p.size) < p


def test_honest_confidences() -> None:
    confidence, right = draws(1.0)
    stated, true, number = reliability(confidence, right)
    np.testing.assert_allclose(stated, true, atol=0.04)
    assert number.sum() == 20_000
    assert calibration_error(confidence, right) < 0.015


def test_boasting_is_seen() -> None:
    """Stated √p where p is true: off by ∫ (√p − p) dp = 1/6 in the mean."""
    confidence, right = draws(0.5)
    assert calibration_error(confidence, right) == pytest.approx(1 / 6, abs=0.01)
    assert negative_log_likelihood(confidence, right) > negative_log_likelihood(*draws(1.0)) + 0.05


def test_likelihood_by_hand() -> None:
    value = negative_log_likelihood(np.array([0.8, 0.4]), np.array([True, False]))
    assert value == pytest.approx(-(np.log(0.8) + np.log(0.6)) / 2)


def test_the_picture(tmp_path: Path) -> None:
    draw_reliability({"honest": draws(1.0), "boasting": draws(0.5)}, tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 5000
