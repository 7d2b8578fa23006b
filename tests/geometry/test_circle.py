"""A circle is found through points of it, however far off they lie, and between points beside it."""

import numpy as np
import pytest

from femoreg_torch.geometry import circle_through


@pytest.mark.parametrize("middle", [(0.0, 0.0), (3e6, -2e6)])
def test_points_of_a_circle_give_it_back(middle: tuple[float, float]) -> None:
    angles = np.linspace(0.3, 2.1, 20)  # a third of it
    points = np.array(middle) + 40.0 * np.c_[np.cos(angles), np.sin(angles)]
    found, radius = circle_through(points)
    np.testing.assert_allclose(found, middle, atol=1e-5)
    assert radius == pytest.approx(40.0, abs=1e-5)


def test_errors_to_both_sides_cancel() -> None:
    angles = np.arange(360) * np.pi / 180
    radii = np.where(np.arange(360) % 2, 41.0, 39.0)
    found, radius = circle_through(radii[:, None] * np.c_[np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(found, 0, atol=1e-9)
    assert radius == pytest.approx(np.sqrt((39**2 + 41**2) / 2))  # the fit is of squares
