"""Levenberg–Marquardt on sums of squares of known minimum."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor

from femoreg_torch.optimize import LevenbergMarquardt, Quadratic, SmoothObjective, Stop


def squares(residuals) -> SmoothObjective:  # type: ignore[no-untyped-def]
    """½ |residuals(δ)|² with the Gauss–Newton matrix by automatic differentiation."""

    def quadratic(delta: Tensor) -> Quadratic:
        r = residuals(delta)
        jacobian = torch.autograd.functional.jacobian(residuals, delta)
        assert isinstance(jacobian, Tensor)
        return Quadratic(float(0.5 * r @ r), r[:, None] * jacobian, jacobian.T @ jacobian)

    return SmoothObjective(lambda deltas: torch.stack([0.5 * residuals(d).square().sum() for d in deltas]), quadratic)


def rosenbrock(delta: Tensor) -> Tensor:
    """Residuals of Rosenbrock's valley, moved so that the minimum is (1, 1) and the start (−1.2, 1) is zero."""
    x, y = delta[0] - 1.2, delta[1] + 1
    return torch.stack([10 * (y - x**2), 1 - x])


def waves(delta: Tensor) -> Tensor:
    """Many local minima around the global one at (2, −1)."""
    d = delta - torch.tensor([2.0, -1.0], dtype=delta.dtype)
    return torch.cat([0.6 * d, torch.sin(3 * d)])


def test_follows_rosenbrocks_valley_to_its_end() -> None:
    result = LevenbergMarquardt(max_iterations=60, tol_x=1e-7, tol_f=1e-14).minimise(squares(rosenbrock), 2, seed=0)
    torch.testing.assert_close(result.delta, torch.tensor([2.2, 0.0], dtype=torch.float64), atol=1e-5, rtol=0)
    assert result.stop in (Stop.SMALL_STEP, Stop.FLAT)
    assert result.evaluations < 60
    assert [value for _, value, _ in result.trace] == sorted((value for _, value, _ in result.trace), reverse=True)


def test_one_start_stays_in_its_valley_and_the_best_of_many_does_not() -> None:
    alone = LevenbergMarquardt().minimise(squares(waves), 2, seed=0)
    scattered = LevenbergMarquardt(candidates=200, starts=40).minimise(squares(waves), 2, seed=0)
    assert alone.value > 0.05
    torch.testing.assert_close(scattered.delta, torch.tensor([2.0, -1.0], dtype=torch.float64), atol=1e-3, rtol=0)
    assert alone.ends == ()
    assert min(value for value, _ in scattered.ends) == pytest.approx(scattered.value)


def test_a_descent_that_comes_where_another_ended_and_fits_no_better_is_given_up() -> None:
    found = LevenbergMarquardt(candidates=200, starts=40).minimise(squares(waves), 2, seed=0)
    alone = LevenbergMarquardt().minimise(squares(waves), 2, seed=0)
    assert 5 < len(found.ends) < 20  # of the valleys; several of the 40 starts lie in each
    assert found.evaluations < 201 + 40 * alone.evaluations
    places = torch.tensor([delta for _, delta in found.ends], dtype=torch.float64)
    for n, (value, _) in enumerate(found.ends):
        near = (places[:n] - places[n]).norm(dim=1) < 0.25
        assert all(value < other for (other, _), same in zip(found.ends, near, strict=False) if same)


def test_scales_of_very_different_stiffness_do_not_matter() -> None:
    stiffness = torch.tensor([1e3, 1.0, 0.05], dtype=torch.float64)
    result = LevenbergMarquardt(tol_f=1e-14).minimise(squares(lambda d: stiffness * (d - 1)), 3, seed=0)
    torch.testing.assert_close(result.delta, torch.ones(3, dtype=torch.float64), atol=1e-4, rtol=0)


def test_the_budget_is_a_reason_to_stop() -> None:
    result = LevenbergMarquardt(max_iterations=2).minimise(squares(rosenbrock), 2, seed=0)
    assert result.stop is Stop.BUDGET
    assert result.evaluations == 3


def test_same_seed_same_bits() -> None:
    settings = LevenbergMarquardt(candidates=20, starts=3)
    first, again, other = (settings.minimise(squares(waves), 2, seed) for seed in (0, 0, 1))
    assert torch.equal(first.delta, again.delta)
    assert first.trace == again.trace
    assert first.trace != other.trace


def rippled(softness: float) -> SmoothObjective:
    """A bowl about (0.3, −0.2), soft along (1, 1), with ripples along it that its curvature does not know of."""
    bottom = torch.tensor([0.3, -0.2], dtype=torch.float64)
    along = torch.tensor([1.0, 1.0], dtype=torch.float64) / 2**0.5
    curvature = torch.eye(2, dtype=torch.float64) + (softness - 1) * along.outer(along)

    def values(deltas: Tensor) -> Tensor:
        away = deltas - bottom
        return 0.5 * (away * (away @ curvature)).sum(1) + 1e-4 * torch.cos(40 * away @ along)

    def quadratic(delta: Tensor) -> Quadratic:
        slope = curvature @ (delta - bottom) - 40 * 1e-4 * torch.sin(40 * (delta - bottom) @ along) * along
        return Quadratic(float(values(delta[None])[0]), slope[None], curvature)

    return SmoothObjective(values, quadratic)


def test_a_parabola_over_the_valley_finds_its_bottom_beneath_the_ripples() -> None:
    bottom = torch.tensor([0.3, -0.2], dtype=torch.float64)
    held_up = LevenbergMarquardt().minimise(rippled(1e-2), 2, seed=0)
    smooth = LevenbergMarquardt(valley=0.4).minimise(rippled(1e-2), 2, seed=0)
    assert float((held_up.delta - bottom).norm()) > 0.05
    assert float((smooth.delta - bottom).norm()) < 0.03
    assert smooth.evaluations == held_up.evaluations + 5
    torch.testing.assert_close(torch.tensor(smooth.trace[-1][2], dtype=torch.float64), smooth.delta)


def test_after_a_step_that_fits_worse_the_next_is_at_most_half_as_long() -> None:
    objective = rippled(1e-2)
    asked: list[tuple[Tensor, float]] = []

    def watched(delta: Tensor) -> Quadratic:
        model = objective.quadratic(delta)
        asked.append((delta, model.value))
        return model

    LevenbergMarquardt(tol_x=1e-3).minimise(SmoothObjective(objective.values, watched), 2, seed=0)
    (here, least), rejected, lengths = asked[0], 0, [float("inf")]
    for delta, value in asked[1:]:
        lengths.append(float((delta - here).norm()))
        if value < least:
            here, least, lengths = delta, value, [float("inf")]
        else:
            rejected += len(lengths) > 2
            assert lengths[-1] <= lengths[-2] / 2 * (1 + 1e-9)
    assert rejected, "no step was rejected twice, so nothing was asked"


def test_no_step_leads_out_of_reach_where_next_to_nothing_bends_the_values() -> None:
    asked: list[Tensor] = []

    def leaning(delta: Tensor) -> Quadratic:
        """Stiff along the first, a slope and hardly a bend along the second."""
        asked.append(delta)
        scores = torch.stack([delta[0], torch.tensor(1.0, dtype=torch.float64)])
        return Quadratic(float(0.5 * delta[0] ** 2 + delta[1]), scores[None], torch.diag(scores.new_tensor([1.0, 0.0])))

    objective = SmoothObjective(lambda deltas: 0.5 * deltas[:, 0].square() + deltas[:, 1], leaning)
    LevenbergMarquardt(max_iterations=3).minimise(objective, 2, seed=0)
    steps = [float((after - before).norm()) for before, after in pairwise(asked)]
    assert max(steps) <= 30
    assert max(steps) > 1


def test_where_nothing_holds_a_direction_no_parabola_is_followed() -> None:
    loose = squares(lambda d: torch.stack([d[0] - 1, 0 * d[1]]))
    result = LevenbergMarquardt(tol_f=1e-14, valley=0.4).minimise(loose, 2, seed=0)
    torch.testing.assert_close(result.delta, torch.tensor([1.0, 0.0], dtype=torch.float64), atol=1e-6, rtol=0)


def test_needs_derivatives() -> None:
    with pytest.raises(TypeError, match="SmoothObjective"):
        LevenbergMarquardt().minimise(lambda deltas: deltas.square().sum(1), 2, seed=0)
