"""The compiled Gaussian blur against SciPy's."""

import numpy as np
import pytest
from scipy import ndimage

from sim.smoothing import gaussian_filter


@pytest.mark.parametrize("sigma", [0.55, 2.0, 8.0, (0.0, 1.0, 3.0), np.array([2.0, 0.3, 0.0])])
@pytest.mark.parametrize("truncate", [4.0, 3.0])
def test_it_is_the_gaussian_filter_of_scipy(sigma, truncate):
    values = np.random.default_rng(1).standard_normal((19, 6, 31), dtype=np.float32)  # 6 is less than a kernel is wide
    expected = ndimage.gaussian_filter(values, sigma, truncate=truncate)
    assert np.abs(gaussian_filter(values, sigma, truncate) - expected).max() < 2e-6


def test_it_works_in_place_and_on_what_is_not_contiguous():
    values = np.random.default_rng(2).standard_normal((9, 8, 7), dtype=np.float32)
    expected = gaussian_filter(values, 1.5)
    assert np.abs(gaussian_filter(values.T, 1.5) - expected.T).max() < 2e-6  # the axes are blurred in another order
    assert gaussian_filter(values, 1.5, out=values) is values
    assert np.array_equal(values, expected)
