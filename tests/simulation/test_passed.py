"""Which limit was passed, and for how long an input was at one."""

import numpy as np

from fflin.simulation.report import passed, saturated


def test_the_limit_that_was_passed_is_named():
    t, limits = np.arange(3.0), np.array([-2.0, 5.0])
    (low,) = passed(t, [("F", np.array([0.0, -3.0, 1.0]), "N", limits)])
    (high,) = passed(t, [("F", np.array([0.0, -1.0, 7.0]), "N", limits)])
    assert (low.limit, low.value, low.time) == (-2.0, -3.0, 1.0)
    assert (high.limit, high.value, high.time) == (5.0, 7.0, 2.0)


def test_a_share_is_one_of_time_and_not_of_rows():
    t = np.array([0.0, 0.1, 0.2, 1.0])
    values = np.array([5.0, 5.0, 0.0, 0.0])
    (one,) = saturated(t, [("F", values, "N", np.array([-5.0, 5.0]))])
    assert np.isclose(one.share, 0.2)
