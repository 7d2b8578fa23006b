"""Every optimiser on problems of known minimum; seeds; reasons to stop."""

import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from femoreg_torch.optimize import Bobyqa, CmaEs, Optimiser, Stop
from femoreg_torch.optimize.result import BestSoFar

MINIMUM = torch.tensor([0.3, -0.2, 0.5, 0.1, -0.4, 0.2], dtype=torch.float64)
SETTINGS = [CmaEs(population=20, max_evaluations=4000), Bobyqa()]


def bowl(deltas: Tensor) -> Tensor:
    """A tilted quadratic, condition 100, minimum 2 at MINIMUM."""
    axes = torch.linalg.qr(torch.vander(torch.linspace(-1, 1, 6, dtype=torch.float64))).Q
    return 2 + (((deltas - MINIMUM) @ axes) ** 2 * torch.logspace(0, 2, 6, dtype=torch.float64)).sum(-1)


def ripples(deltas: Tensor) -> Tensor:
    """Many local minima around the global one at MINIMUM (Rastrigin)."""
    d = deltas - MINIMUM
    return (d**2 + 0.05 * (1 - torch.cos(12 * d))).sum(-1)


@pytest.mark.parametrize("settings", SETTINGS)
def test_finds_the_minimum_of_a_bowl(settings: Optimiser) -> None:
    result = settings.minimise(bowl, 6, seed=1)
    torch.testing.assert_close(result.delta, MINIMUM, atol=2e-3, rtol=0)
    assert result.value == pytest.approx(2, abs=1e-3)
    assert result.stop in (Stop.SMALL_STEP, Stop.FLAT)


def test_cma_es_crosses_local_minima() -> None:
    result = CmaEs(population=60, max_evaluations=8000).minimise(ripples, 6, seed=0)
    torch.testing.assert_close(result.delta, MINIMUM, atol=1e-2, rtol=0)


@pytest.mark.parametrize("settings", SETTINGS)
def test_result_is_the_best_point_met_and_the_trace_falls(settings: Optimiser) -> None:
    met: list[float] = []

    def watched(deltas: Tensor) -> Tensor:
        values = bowl(deltas)
        met.extend(values.tolist())
        return values

    result = settings.minimise(watched, 6, seed=3)
    assert result.value == min(met) == result.trace[-1][1]
    assert result.evaluations == len(met)
    assert [value for _, value, _ in result.trace] == sorted((value for _, value, _ in result.trace), reverse=True)


def test_searches_side_by_side_are_those_one_after_the_other() -> None:
    """Views are searched in threads; and who calls keeps NumPy's own generator as it was."""
    settings = CmaEs(population=12, max_evaluations=300)

    def slowly(deltas: Tensor) -> Tensor:
        time.sleep(1e-3)  # lets the other thread draw its numbers
        return bowl(deltas)

    np.random.seed(5)  # noqa: NPY002
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    alone = [settings.minimise(slowly, 6, seed).delta for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        together = [found.delta for found in pool.map(lambda seed: settings.minimise(slowly, 6, seed), (0, 1))]
    assert all(torch.equal(*pair) for pair in zip(alone, together, strict=True))
    assert np.random.random() == expected  # noqa: NPY002


def test_same_seed_same_bits_other_seed_another_path() -> None:
    settings = CmaEs(population=12, max_evaluations=300)
    first, again, other = (settings.minimise(bowl, 6, seed) for seed in (0, 0, 1))
    assert torch.equal(first.delta, again.delta)
    assert first.trace == again.trace
    assert not torch.equal(first.delta, other.delta)


def test_cma_es_takes_seeds_of_more_than_32_bits() -> None:
    """A registration numbers its stages by its seed times 1000, and studies have seeds of 31 bits."""
    settings = CmaEs(population=12, max_evaluations=300)
    first, second = (settings.minimise(bowl, 6, (2**31 - 1) * 1000 + stage) for stage in (1, 2))
    assert not torch.equal(first.delta, second.delta)


@pytest.mark.parametrize("settings", [CmaEs(population=10, max_evaluations=50), Bobyqa(max_evaluations=20)])
def test_the_budget_is_kept(settings: Optimiser) -> None:
    result = settings.minimise(ripples, 6, seed=0)
    assert result.stop is Stop.BUDGET
    assert result.evaluations <= settings.max_evaluations + 12  # a generation, the start and the mean


def test_bobyqa_stays_in_its_box() -> None:
    result = Bobyqa().minimise(lambda d: ((d - 3) ** 2).sum(-1), 2, seed=0)
    torch.testing.assert_close(result.delta, torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # cma takes the mean of nothing on its way
def test_an_objective_that_is_never_finite_is_an_error(settings: Optimiser) -> None:
    with pytest.raises((ArithmeticError, ValueError, RuntimeError)):
        settings.minimise(lambda d: torch.full((len(d),), torch.nan, dtype=torch.float64), 2, seed=0)


def test_a_nan_does_not_hide_the_finite_values_beside_it() -> None:
    best = BestSoFar(lambda deltas: deltas[:, 0])
    best(torch.tensor([[2.0], [math.nan], [0.5]], dtype=torch.float64))
    assert best.result(Stop.BUDGET).value == 0.5
