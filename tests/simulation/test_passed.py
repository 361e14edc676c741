"""Which limit was passed, and for how long an input was at one."""

import numpy as np

from fflin.simulation.report import Curve, passed, saturated


def curve(values, limits):
    return Curve("F_b.x", "F_b", "F_b.x", "N", np.array(values), limits)


def test_the_limit_that_was_passed_is_named():
    t, limits = np.arange(3.0), np.array([-2.0, 5.0])
    (low,) = passed(t, [curve([0.0, -3.0, 1.0], limits)])
    (high,) = passed(t, [curve([0.0, -1.0, 7.0], limits)])
    assert (low.limit, low.value, low.time) == (-2.0, -3.0, 1.0)
    assert (high.limit, high.value, high.time) == (5.0, 7.0, 2.0)


def test_a_share_is_one_of_time_and_not_of_rows():
    t = np.array([0.0, 0.1, 0.2, 1.0])
    (one,) = saturated(t, [curve([5.0, 5.0, 0.0, 0.0], np.array([-5.0, 5.0]))])
    assert np.isclose(one.share, 0.2)
