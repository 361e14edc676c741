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


def test_a_wheel_that_passes_its_largest_speed_is_not_held_at_it():
    """A limit that is not enforced appears as a violation only."""
    t, limits = np.arange(5.0), np.array([-100.0, 100.0])

    def speed(values):
        return Curve("w", "speed", "w", "rad/s", np.array(values), limits)

    assert not saturated(t, [speed([0.0, 50.0, 100.0, 150.0, 200.0])])
    assert passed(t, [speed([0.0, 50.0, 100.0, 150.0, 200.0])])
    (one,) = saturated(t, [speed([0.0, 50.0, 99.95, 100.0, 100.05])])
    assert one.limit == 100.0
    (one,) = saturated(t, [speed([-100.0, -100.0, 50.0, 100.0, 150.0])])
    assert one.limit == -100.0
