"""Intervals hold what they should as often as they say; correlations of constructed data."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, t

from femoreg_torch.statistics.intervals import difference_interval, mean_interval, pearson, rate_interval, spearman


def test_the_interval_of_a_mean_holds_the_true_mean_in_95_of_100_samples() -> None:
    """Of normal samples with a known mean; 200 samples leave the share uncertain by 0.015."""
    rng = np.random.default_rng(5)
    held = [low <= 3.0 <= high for low, high in (mean_interval(rng.normal(3, 2, 60), 0) for _ in range(200))]
    assert 0.90 <= np.mean(held) <= 0.985


def test_the_interval_of_a_mean_is_that_of_students_t() -> None:
    values = np.random.default_rng(0).normal(10, 2, 400)
    low, high = mean_interval(values, 1)
    half = 1.966 * values.std(ddof=1) / math.sqrt(400)
    assert low == pytest.approx(values.mean() - half, abs=0.03)
    assert high == pytest.approx(values.mean() + half, abs=0.03)
    assert mean_interval(values, 1) == (low, high)  # the same seed, the same bits


def test_the_interval_of_a_difference_is_that_of_two_normal_means() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(5, 1, 300), rng.normal(4, 2, 200)
    half = 1.96 * math.sqrt(a.var(ddof=1) / 300 + b.var(ddof=1) / 200)
    low, high = difference_interval(a, b, 0)
    assert low == pytest.approx(a.mean() - b.mean() - half, abs=0.04)
    assert high == pytest.approx(a.mean() - b.mean() + half, abs=0.04)


@pytest.mark.parametrize("count", [2, 4, 9])
def test_intervals_of_few_hold_the_truth_as_often(count: int) -> None:
    """Of 300 pairs of samples of the same distribution; the bootstrap of two called 30 % of them different."""
    rng = np.random.default_rng(1)
    pairs = [(rng.normal(3, 2, count), rng.normal(3, 2, count)) for _ in range(300)]
    means = [low <= 3.0 <= high for low, high in (mean_interval(first, 0) for first, _ in pairs)]
    alike = [low <= 0 <= high for low, high in (difference_interval(*pair, 0) for pair in pairs)]
    assert np.mean(means) > 0.92
    assert np.mean(alike) > 0.92


def test_the_interval_of_few_clusters_counts_them_once() -> None:
    """Ten copies of each of five values tell no more than the five."""
    values = np.array([1.0, 4.0, 2.0, 7.0, 3.0])
    clusters = np.repeat(np.arange(5), 10)
    assert mean_interval(np.repeat(values, 10), 0, clusters) == pytest.approx(mean_interval(values, 0))
    half = 2.776 * values.std(ddof=1) / math.sqrt(5)  # Student's t of four degrees of freedom
    assert mean_interval(values, 0) == pytest.approx((values.mean() - half, values.mean() + half), abs=1e-3)


def test_ranks_in_perfect_order_tell_nothing_of_their_spread() -> None:
    found = spearman([1.0, 2, 3, 4], [1.0, 4, 9, 16])
    assert found.value == pytest.approx(1)
    assert all(math.isnan(end) for end in found.interval)


@pytest.mark.parametrize("values", [[], [1.0], [2.0, 2.0, 2.0]])
def test_a_sample_that_says_nothing_of_its_spread_has_no_interval(values: list[float]) -> None:
    assert all(math.isnan(end) for end in mean_interval(values, 0))
    assert all(math.isnan(end) for end in difference_interval(values, [3.0, 3.0], 0))


@pytest.mark.parametrize("count", [3, 30])
def test_a_difference_takes_its_spread_from_the_sample_that_has_one(count: int) -> None:
    """Beside a constant it is Student's interval of the other mean."""
    values = np.random.default_rng(4).normal(5, 1, count)
    half = t.ppf(0.975, count - 1) * values.std(ddof=1) / math.sqrt(count)
    expected = values.mean() - 2 - half, values.mean() - 2 + half
    assert difference_interval(values, np.full(20, 2.0), 0) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.1705, 0.8090)),
        ((5, 56), (0, 29), (-0.0381, 0.1926)),
        ((0, 10), (0, 20), (-0.1611, 0.2775)),
        ((10, 10), (0, 20), (0.6791, 1.0)),
    ],
)
def test_the_interval_of_a_difference_of_rates_is_newcombes(
    first: tuple[int, int], second: tuple[int, int], expected: tuple[float, float]
) -> None:
    """The figures of his Table II, method 10."""
    samples = [np.arange(of) < met for met, of in (first, second)]
    assert difference_interval(*samples, 0) == pytest.approx(expected, abs=6e-5)


def test_a_study_without_failure_beside_one_with_some_has_an_interval_that_holds() -> None:
    """Of 1000 pairs of 40 runs that succeed in 98 and 90 %; a third of the first has no failure."""
    rng = np.random.default_rng(6)
    pairs = [difference_interval(rng.random(40) < 0.98, rng.random(40) < 0.90, 0) for _ in range(1000)]
    assert np.mean([low <= 0.08 <= high for low, high in pairs]) > 0.93


def test_the_interval_of_a_rate_is_wilsons() -> None:
    """Of 0 of n it ends at z² / (n + z²)."""
    assert rate_interval(0, 60) == pytest.approx((0, 1.95996**2 / (60 + 1.95996**2)), abs=1e-5)
    assert all(math.isnan(end) for end in rate_interval(0, 0))


def test_correlations_of_constructed_data() -> None:
    pairs = multivariate_normal([0, 0], [[1, 0.8], [0.8, 1]], seed=np.random.default_rng(0)).rvs(4000)
    x, y = pairs.T
    linear, ranks = pearson(x, y), spearman(x, y)
    assert linear.interval[0] < 0.8 < linear.interval[1]
    assert ranks.interval[0] < 6 / math.pi * math.asin(0.4) < ranks.interval[1]  # of a normal pair
    assert linear.interval[1] - linear.interval[0] < 0.03
    assert spearman(x, np.exp(3 * y)).value == pytest.approx(ranks.value)  # ranks know no scale
    assert pearson(x, -2 * x).value == pytest.approx(-1)


def test_pairs_that_are_not_both_known_do_not_count() -> None:
    x = np.array([1.0, 2, 3, 4, 5, np.nan, 7])
    y = np.array([2.0, 4, 6, 8, 10, 1, np.inf])
    assert (pearson(x, y).count, pearson(x, y).value) == (5, pytest.approx(1))
    assert math.isnan(pearson(x[:3], y[:3]).value)
    assert math.isnan(spearman(np.ones(9), np.arange(9.0)).value)
