"""Distance fields: values between nodes against SciPy's interpolation, unions of balls against all balls."""

import numpy as np
import pytest
from scipy import ndimage

from sim.patient.distance_field import Field, ball_union

AXES = np.linspace(-1.5, 9.0, 23), np.linspace(2.0, 7.9, 17), np.linspace(-4.0, 6.5, 31)


@pytest.fixture(scope="module")
def field():
    values = np.random.default_rng(0).standard_normal((9, 7, 8), dtype=np.float32)
    return Field(values, np.array([-2.0, 1.0, -5.0]), 1.5)


def test_values_on_a_grid_are_trilinear_and_those_of_the_edge_beyond_it(field):
    index = [(axis - low) / field.step for axis, low in zip(AXES, field.lo, strict=True)]
    expected = ndimage.map_coordinates(field.values, np.meshgrid(*index, indexing="ij"), order=1, mode="nearest")
    assert np.abs(field.on_axes(*AXES) - expected).max() < 1e-5


def test_values_at_some_voxels_are_those_of_the_grid(field):
    whole = field.on_axes(*AXES)
    some = np.nonzero(whole > 0.3)
    assert len(some[0]) > 100
    assert np.array_equal(field.at_voxels(AXES, some), whole[some])


def test_a_union_of_balls_is_as_far_as_the_ball_of_least_power():
    """Against all balls at every node near the surface; there are large and small ones, and some within others."""
    rng = np.random.default_rng(4)
    balls = np.c_[rng.uniform(-20, 20, (300, 3)), rng.uniform(0.5, 9, 300)]
    field = ball_union(balls, 1.3)
    nodes = np.stack(np.meshgrid(*field.axes(), indexing="ij"), -1).astype(float)
    powers = ((nodes[..., None, :] - balls[:, :3]) ** 2).sum(-1) - balls[:, 3] ** 2
    radius = balls[:, 3][powers.argmin(-1)]
    expected = np.sqrt(powers.min(-1) + radius**2) - radius
    near = np.abs(expected) < 2.5
    assert near.mean() > 0.1
    assert np.abs(field.values - expected)[near].max() < 1e-4
    assert (np.sign(field.values) == np.sign(expected))[~near].all()
