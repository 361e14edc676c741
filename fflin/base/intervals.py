"""Confidence intervals of fractions, quantiles and means; rank correlations.

C. J. Clopper and E. S. Pearson, Biometrika 26(4), 1934; H. A. David and H. N. Nagaraja, Order
Statistics, 3rd edition, 2003, section 7.1.
"""

import math
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array


class Estimate(NamedTuple):
    """Estimated value, with the lower and upper ends of its confidence interval."""

    value: float
    low: float
    high: float


def clopper_pearson(successes: int, count: int, confidence: float) -> Estimate:
    """Return the fraction of successes, and its exact confidence interval (Clopper-Pearson)."""
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2.0
    failures = count - successes
    low = 0.0
    if successes:
        low = betaincinv(successes, failures + 1, tail)
    high = 1.0
    if failures:
        high = betaincinv(successes + 1, failures, 1.0 - tail)
    fraction = successes / count if count else math.nan
    return Estimate(fraction, float(low), float(high))


def until_failure(
    failed: Array, confidence: float
) -> tuple[int, float, tuple[float, float]]:
    """Return success statistics of N runs.

    `failed` (N,) is true for each failed run. The runs must be sorted by increasing initial
    displacement. The statistics are

    - the number of runs before the first failure;
    - a lower bound on the success rate at the displacements of these runs;
    - the confidence interval (low, high) for the success rate of all runs.
    """
    count = len(failed)
    inside = count
    if failed.any():
        inside = int(failed.argmax())
    bound = 0.0
    if inside:
        bound = (1.0 - confidence) ** (1.0 / inside)
    _, low, high = clopper_pearson(count - int(failed.sum()), count, confidence)
    return inside, bound, (low, high)


def quantile(values: Array, p: float, confidence: float) -> Estimate:
    """Return the p-quantile with its confidence interval.

    An end of the interval is infinite if there are too few values.
    """
    from scipy.special import bdtr

    count = len(values)
    ordered = np.concatenate(([-np.inf], np.sort(values), [np.inf]))
    # The number of values below the quantile has a binomial distribution.
    below = bdtr(np.arange(count + 1.0), count, p)
    tail = (1.0 - confidence) / 2.0
    low, high = np.searchsorted(below, (tail, 1.0 - tail)).tolist()
    middle = min(max(math.ceil(p * count), 1), count)
    return Estimate(
        *map(float, (ordered[middle], ordered[low], ordered[min(high, count) + 1]))
    )


def mean(values: Array, confidence: float) -> Estimate:
    """Return the mean and its Student's t interval, which assumes normally distributed values."""
    from scipy.special import stdtrit

    count, middle = len(values), float(values.mean())
    if count < 2:
        return Estimate(middle, -math.inf, math.inf)
    t = float(stdtrit(count - 1, 0.5 + 0.5 * confidence))
    apart = t * float(values.std(ddof=1)) / math.sqrt(count)
    return Estimate(middle, middle - apart, middle + apart)


def rank_correlations(columns: Array, values: Array) -> Array:
    """Return Spearman's rank correlation (k,) of each column with `values`.

    `columns` is an array (N, k). `values` is an array (N,), which may contain inf. The correlation
    with a constant array is 0.
    """
    ranks = np.empty((len(values), columns.shape[1] + 1))
    for k, column in enumerate((*columns.T, values)):
        # Equal values all get the mean of their ranks.
        _, which, counts = np.unique(column, return_inverse=True, return_counts=True)
        ranks[:, k] = (np.cumsum(counts) - 0.5 * (counts - 1))[which]
    ranks -= ranks.mean(axis=0)
    size = np.linalg.norm(ranks, axis=0)
    shares = ranks / np.where(size > 0.0, size, 1.0)
    correlations: Array = shares[:, :-1].T @ shares[:, -1]
    return correlations
