"""Rigid maths against SciPy, against literal cases of each convention, and by laws over random transforms."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import (
    about_point,
    check_rigid,
    euler_xyz_deg,
    exp_se3,
    exp_so3,
    invert_rigid,
    log_se3,
    log_so3,
    rigid,
    rotation_angle,
    transform_points,
    twist_rates,
)

AXES = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (-1 / 3, 2 / 3, 2 / 3)]
ANGLES = [0.0, 1e-9, 1e-5, 9.999e-3, 1.0001e-2, 0.3, 1.5, 3.0, math.pi - 1e-3, math.pi - 1e-6, math.pi - 1e-9]

numbers = st.floats(-1, 1, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers).map(lambda v: torch.tensor(v, dtype=torch.float64))
twists = st.tuples(vectors, vectors).map(lambda v: torch.cat([1.8 * v[0], 200 * v[1]]))  # up to 3.12 rad and 350 mm
transforms = twists.map(exp_se3)


def rotation_vector(axis: tuple[float, float, float], angle: float) -> Tensor:
    return angle * torch.tensor(axis, dtype=torch.float64)


# Literal cases -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("axis", "start", "end"),
    [("z", (1, 0, 0), (0, 1, 0)), ("x", (0, 1, 0), (0, 0, 1)), ("y", (0, 0, 1), (1, 0, 0))],
)
def test_plus_90_degrees_turns_by_the_right_hand_rule(axis, start, end):
    vector = math.pi / 2 * torch.tensor([float(a == axis) for a in "xyz"], dtype=torch.float64)
    turned = exp_so3(vector) @ torch.tensor(start, dtype=torch.float64)
    assert_close(turned, torch.tensor(end, dtype=torch.float64), atol=1e-15, rtol=0)


def test_a_transform_turns_first_and_shifts_afterwards():
    b_from_a = rigid(
        exp_so3(rotation_vector((0, 0, 1), math.pi / 2)), torch.tensor([10.0, 20.0, 30.0], dtype=torch.float64)
    )
    points = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 5.0]], dtype=torch.float64)
    expected = torch.tensor([[10.0, 21.0, 30.0], [9.0, 20.0, 35.0]], dtype=torch.float64)
    assert_close(transform_points(b_from_a, points), expected)


def test_a_screw_of_half_a_turn_moves_by_the_diameter():
    """A twist (π about z, v along x) is half a circle of length |v|: the origin ends 2 v / π to the side."""
    moved = exp_se3(torch.tensor([0, 0, math.pi, 5.0, 0, 0], dtype=torch.float64))[:3, 3]
    assert_close(moved, torch.tensor([0.0, 2 * 5 / math.pi, 0.0], dtype=torch.float64), atol=1e-14, rtol=0)


def test_about_point_leaves_the_point_where_it_is():
    centre = torch.tensor([3.0, -4.0, 700.0], dtype=torch.float64)
    turned = about_point(rigid(exp_so3(rotation_vector((0, 0, 1), math.pi / 2))), centre)
    points = torch.stack([centre, centre + torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)])
    assert_close(transform_points(turned, points), centre + torch.tensor([[0.0, 0, 0], [0, 1, 0]], dtype=torch.float64))


# Against SciPy -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("angle", [*ANGLES, math.pi])
@pytest.mark.parametrize("axis", AXES)
def test_exp_and_log_agree_with_scipy(axis, angle):
    vector = rotation_vector(axis, angle)
    rotation = exp_so3(vector)
    assert_close(rotation, torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix()), atol=1e-14, rtol=0)
    assert_close(rotation_angle(rotation).item(), angle, atol=1e-15, rtol=1e-12)
    back = log_so3(rotation)
    assert back.norm() <= math.pi + 1e-14
    assert_close(exp_so3(back), rotation, atol=1e-14, rtol=0)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a < math.pi - 1e-7])
@pytest.mark.parametrize("axis", AXES)
def test_log_gives_the_rotation_vector_back(axis, angle):
    """Closer to π, a rounded matrix no longer knows the sign of its axis."""
    vector = rotation_vector(axis, angle)
    assert_close(log_so3(exp_so3(vector)), vector, atol=1e-15, rtol=1e-12)


def test_log_of_random_rotations_in_a_batch_agrees_with_scipy():
    truth = Rotation.random(500, rng=np.random.default_rng(0))
    vectors = log_so3(torch.from_numpy(truth.as_matrix()).reshape(20, 25, 3, 3))
    assert_close(vectors.reshape(-1, 3), torch.from_numpy(truth.as_rotvec()), atol=1e-13, rtol=0)


def test_euler_angles_are_about_fixed_axes_x_then_y_then_z():
    truth = Rotation.random(200, rng=np.random.default_rng(1))
    angles = euler_xyz_deg(torch.from_numpy(truth.as_matrix()))
    assert_close(angles, torch.from_numpy(truth.as_euler("xyz", degrees=True)), atol=1e-11, rtol=0)
    about_z = euler_xyz_deg(exp_so3(rotation_vector((0, 0, 1), math.radians(30))))
    assert_close(about_z, torch.tensor([0.0, 0.0, 30.0], dtype=torch.float64), atol=1e-13, rtol=0)


def test_exp_se3_agrees_with_the_matrix_exponential():
    generator = torch.Generator().manual_seed(0)
    for scale in (1e-9, 1e-3, 0.1, 1.0):
        twist = torch.randn(6, generator=generator, dtype=torch.float64) * torch.tensor([scale] * 3 + [50.0] * 3)
        x, y, z = twist[:3].tolist()
        algebra = torch.zeros(4, 4, dtype=torch.float64)
        algebra[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        algebra[:3, 3] = twist[3:]
        assert_close(exp_se3(twist), torch.linalg.matrix_exp(algebra), atol=1e-11, rtol=1e-12)


def test_twist_rates_are_those_of_the_twist_that_moves_a_pose():
    generator = torch.Generator().manual_seed(3)
    twist, pose = torch.randn(2, 6, generator=generator).double()
    pose, centre = exp_se3(pose), torch.tensor([3.0, -50.0, 700.0], dtype=torch.float64)
    step = 1e-6
    moved = [about_point(exp_se3(sign * step * twist), centre) @ pose for sign in (1, -1)]
    rates = twist_rates(((moved[0] - moved[1]) / (2 * step))[None], pose, centre)
    assert_close(rates[:, 0], twist, atol=1e-6, rtol=1e-6)


# Round trips and derivatives -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("angle", [a for a in ANGLES if a < math.pi - 1e-4])
def test_log_se3_inverts_exp_se3(angle):
    for axis in AXES:
        twist = torch.cat([rotation_vector(axis, angle), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)])
        assert_close(log_se3(exp_se3(twist)), twist, atol=1e-13, rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 9e-3, 1.1e-2, 1.0, math.pi - 0.02])
def test_float32_round_trip(angle):
    twist = torch.cat(
        [rotation_vector(AXES[-1], angle), torch.tensor([100.0, -20.0, 30.0], dtype=torch.float64)]
    ).float()
    assert_close(log_se3(exp_se3(twist)), twist, atol=2e-4, rtol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-2, 0.5, math.pi - 1e-3])
def test_gradients_agree_with_finite_differences(angle):
    twist = torch.cat(
        [rotation_vector(AXES[-1], angle), torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)]
    ).requires_grad_()
    assert torch.autograd.gradcheck(exp_se3, (twist,))
    assert torch.autograd.gradcheck(lambda t: log_se3(exp_se3(t)), (twist,), atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 2.0, math.pi - 1e-5])
@pytest.mark.parametrize("axis", AXES)
def test_the_derivative_of_the_round_trip_is_the_identity(axis, angle):
    jacobian = torch.autograd.functional.jacobian(lambda v: log_so3(exp_so3(v)), rotation_vector(axis, angle))
    assert_close(jacobian, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)


# Laws ----------------------------------------------------------------------------------------------------------------
@given(transforms, transforms, vectors)
def test_transforms_compose(c_from_b, b_from_a, point):
    points = 100 * point[None]
    one_by_one = transform_points(c_from_b, transform_points(b_from_a, points))
    assert_close(transform_points(c_from_b @ b_from_a, points), one_by_one, atol=1e-11, rtol=1e-12)


@given(transforms)
def test_inverse_undoes_on_both_sides(b_from_a):
    eye = torch.eye(4, dtype=torch.float64)
    assert_close(invert_rigid(b_from_a) @ b_from_a, eye, atol=1e-12, rtol=0)
    assert_close(b_from_a @ invert_rigid(b_from_a), eye, atol=1e-12, rtol=0)
    assert check_rigid(b_from_a, "here") is b_from_a


@given(transforms)
def test_a_transform_with_few_digits_is_made_rigid(b_from_a):
    turned = b_from_a[:3, :3]
    written = rigid((turned * 1e4).round() / 1e4, b_from_a[:3, 3])
    found = check_rigid(written, "here")
    assert_close(found, b_from_a, atol=1e-4, rtol=0)
    assert_close(found[:3, :3] @ found[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)


@given(transforms, vectors)
def test_about_point_is_a_change_of_origin(transform, centre):
    there, back = rigid(translation=100 * centre), rigid(translation=-100 * centre)
    assert_close(about_point(transform, 100 * centre), there @ transform @ back, atol=1e-12, rtol=1e-12)


@given(twists)
@settings(max_examples=200)
def test_round_trip_of_random_twists(twist):
    """Beyond half a turn the shortest way round is another twist, so the transforms are compared."""
    transform = exp_se3(twist)
    assert_close(exp_se3(log_se3(transform)), transform, atol=1e-11, rtol=1e-12)
    assert_close(torch.linalg.det(transform[:3, :3]).item(), 1.0, atol=1e-12, rtol=0)


def test_batches_broadcast():
    generator = torch.Generator().manual_seed(0)
    twist = torch.randn(4, 5, 6, generator=generator, dtype=torch.float64)
    batch = exp_se3(twist)
    assert batch.shape == (4, 5, 4, 4)
    assert_close(batch[2, 3], exp_se3(twist[2, 3]), atol=1e-14, rtol=1e-14)
    assert_close(log_se3(batch)[1, 4], log_se3(batch[1, 4]), atol=1e-13, rtol=1e-13)
    assert rigid(translation=torch.zeros(2, 3)).shape == (2, 4, 4)
    assert rigid(batch[0, :, :3, :3], torch.zeros(3).double()).shape == (5, 4, 4)
    assert_close(rigid(), torch.eye(4, dtype=torch.float64))


# Bad input -----------------------------------------------------------------------------------------------------------
def broken(kind: str) -> Tensor:
    transform = exp_se3(torch.tensor([0.1, 0.2, 0.3, 1, 2, 3], dtype=torch.float64))
    match kind:
        case "shape":
            return transform[:3]
        case "nan":
            transform[1, 2] = math.nan
        case "scale":
            transform[:3, :3] *= 1.01
        case "mirror":
            transform[:3, 0] *= -1
        case "last row":
            transform[3, 0] = 0.5
    return transform


@pytest.mark.parametrize(
    ("kind", "words"),
    [("shape", "4×4"), ("nan", "not finite"), ("scale", "scaling"), ("mirror", "mirrored"), ("last row", "last row")],
)
def test_what_is_not_rigid_is_refused_by_name(kind, words):
    with pytest.raises(InputError, match=words) as error:
        check_rigid(broken(kind), "truth.json, camera1_from_femur")
    assert str(error.value).startswith("truth.json, camera1_from_femur: ")
