"""Intervals that hold as often as they say, and ranks against SciPy's."""

import numpy as np
import pytest
from scipy import stats

from fflin.base import intervals


@pytest.mark.parametrize("successes, count", [(0, 10), (3, 10), (10, 10), (411, 1000)])
def test_the_share_is_clopper_and_pearsons(successes, count):
    expected = stats.binomtest(successes, count).proportion_ci(0.9)
    result = intervals.clopper_pearson(successes, count, 0.9)
    assert result == pytest.approx(
        (successes / count, expected.low, expected.high), rel=1e-9
    )


@pytest.mark.parametrize("p", [0.05, 0.5, 0.9])
@pytest.mark.parametrize("count", [20, 151])
def test_the_interval_of_a_quantile_holds_as_often_as_binomial_says(p, count):
    rng, within = np.random.default_rng(7), 0
    truth = stats.expon.ppf(p)
    for _ in range(1000):
        result = intervals.quantile(rng.exponential(size=count), p, 0.9)
        assert result.low <= result.value <= result.high
        within += result.low <= truth <= result.high
    # At least 900, and no more than one order statistic too wide on either side.
    assert 870 <= within <= 1000
    ranks = np.arange(1.0, count + 1)
    low, high = (int(x) for x in stats.binom.ppf((0.05, 0.95), count, p))
    assert intervals.quantile(ranks, p, 0.9)[1:] == (
        low or -np.inf,
        high + 1 if high < count else np.inf,
    )


def test_the_mean_has_students_interval():
    values = np.random.default_rng(1).normal(size=30)
    expected = stats.t.interval(0.8, 29, values.mean(), stats.sem(values))
    result = intervals.mean(values, 0.8)
    assert result == pytest.approx((values.mean(), *expected), rel=1e-12)
    assert intervals.mean(values[:1], 0.8)[1:] == (-np.inf, np.inf)


def test_ranks_are_spearmans_with_ties_and_without_end():
    rng = np.random.default_rng(2)
    columns, values = rng.integers(0, 5, (40, 3)).astype(float), rng.normal(size=40)
    values[:4] = np.inf
    expected = [
        stats.spearmanr(column, np.minimum(values, 99.0))[0] for column in columns.T
    ]
    assert intervals.rank_correlations(columns, values) == pytest.approx(
        expected, rel=1e-12
    )
    assert intervals.rank_correlations(np.ones((40, 1)), values) == [0.0]
