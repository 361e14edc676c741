"""Comparison of the starts of a search."""

import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from fflin.tuning.search import Term
from fflin.tuning.starts import Start, reached, searched


class Valley:
    """Problem with one parameter and given starts: a soft value and a hard goal."""

    simpler = None
    bounds = np.array([-1.0]), np.array([1.0])

    structured = SimpleNamespace(has_gain=False)

    def __init__(self, ends):
        self.ends = list(ends)
        self.drawn = iter(self.ends)

    def start(self, rng=None):
        self.soft, self.hard = next(self.drawn)
        return np.zeros(1)

    def evaluate(self, x):
        flat = partial(np.zeros, 1)
        terms = [Term(math.log(self.soft), False, "soft", math.nan, flat)]
        if self.hard is not None:
            terms.append(Term(math.log(self.hard), True, "hard", math.nan, flat))
        return terms


def search(*ends):
    best, starts = searched(Valley(ends), len(ends), 5, 0)
    return best, [start.value for start in starts], reached(starts)


def test_starts_with_active_hard_goals_are_compared_by_the_soft_goals():
    best, values, near = search((0.2135, 1.0 + 5e-7), (0.1701, 1.0), (0.3, 0.5))
    assert math.exp(best.objective) == pytest.approx(0.1701)
    assert values == pytest.approx([0.2135, 0.1701, 0.3])
    assert near == 1


def test_a_start_that_meets_the_hard_goals_is_better_than_a_smaller_value():
    best, values, near = search((0.1, 1.5), (2.0, 1.0), (0.1, 1.2))
    assert math.exp(best.objective) == pytest.approx(2.0)
    assert values == pytest.approx([1.5, 2.0, 1.2])
    assert near == 1


def test_starts_that_miss_hard_goals_are_compared_by_the_hard_goals():
    best, values, near = search((0.1, 1.5), (3.0, 1.2), (5.0, 1.205))
    assert math.exp(best.violation) == pytest.approx(1.2)
    assert values == pytest.approx([1.5, 1.2, 1.205])
    assert near == 2


def test_without_constraints_the_value_decides():
    best, values, near = search((1.5, None), (1.2, None))
    assert math.exp(best.objective) == pytest.approx(1.2)
    assert values == pytest.approx([1.5, 1.2]) and near == 1


def test_unstable_starts_reach_no_value():
    assert reached([]) == 0
    assert reached([Start(math.inf, False)]) == 0
    assert reached([Start(math.inf, False), Start(2.0, False)]) == 1
