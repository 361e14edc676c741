"""What a simulation does with policies, events, disturbances and times that are not as they ought.

Nothing that is not finite is ever recorded, and nobody else's memory is shared.
"""

import math

import numpy as np
import pytest
from test_simulation import displaced, free_body, regulated

import fflin


def finite(motion):
    names = ("t", "q", "v", "x", "u", "energy", "momentum", "momentum_drift", "prediction")
    return all(np.isfinite(getattr(motion, name)).all() for name in names)


def after_half_a_second(value):
    return lambda t, q, v: np.full(6, value if t > 0.5 else 0.0)


@pytest.mark.parametrize("sample", [None, 0.1])
@pytest.mark.parametrize(
    ("policy", "said"),
    [
        (after_half_a_second(math.nan), "gave nan for tau_b.x at t = 0."),
        (after_half_a_second(math.inf), "gave inf for tau_b.x at t = 0."),
        (lambda t, q, v: None, "holds object values"),
        (lambda t, q, v: "push", "expected real numbers"),
        (lambda t, q, v: [[1.0], [1.0, 2.0]], "rows differ in length"),
        (lambda t, q, v: np.full(6, 1j), "holds complex128 values"),
        (lambda t, q, v: np.zeros((6, 1)), "gave shape (6, 1) at t = 0 s, expected (6,)"),
    ],
)
def test_a_policy_that_gives_no_inputs_is_refused(policy, said, sample):
    robot = free_body((20.0, 30.0, 40.0))
    with pytest.raises(fflin.InputError) as caught:
        fflin.simulate(robot, policy, duration=1.0, sample=sample)
    assert said in str(caught.value)


def test_an_infinite_command_within_limits_is_the_limit():
    robot = free_body((20.0, 30.0, 40.0))
    motion = fflin.simulate(robot, after_half_a_second(math.inf), duration=1.0, limits=2.0)
    assert finite(motion)
    assert motion.u[-1, 0] == 2.0
    with pytest.raises(fflin.InputError, match="gave nan for tau_b"):
        fflin.simulate(robot, after_half_a_second(math.nan), duration=1.0, limits=2.0)


def test_a_policy_may_keep_and_change_what_it_is_given_and_gives():
    robot = free_body((20.0, 30.0, 40.0))
    kept, u = [], np.zeros(6)

    def clean(t, q, v):
        return np.full(6, math.sin(10.0 * t))

    def careless(t, q, v):
        u[:] = clean(t, q, v)
        kept.append((t, q, v, v.copy()))
        q[:] = 7.0
        return u

    def spoil(t, q, v, *rest):
        for array in (q, v, *rest):
            array[:] = 7.0
        return 1.0

    for options in ({}, {"sample": 0.1, "delay": 0.2}):
        asked, given = (
            fflin.simulate(robot, policy, duration=1.0, **options, **watched)
            for policy, watched in ((clean, {}), (careless, {"events": [spoil], "callback": spoil}))
        )
        np.testing.assert_array_equal(given.x, asked.x)
        np.testing.assert_array_equal(given.u, asked.u)
        assert given.u.any()
    assert all(np.array_equal(v, then) for _, _, v, then in kept)


def test_an_unstable_loop_has_neither_warnings_nor_an_infinite_prediction():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, -gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin, 5.0), duration=100.0)
    assert motion.stopped.startswith("diverged at t")
    assert finite(motion)
    held = fflin.simulate(robot, policy, x0=displaced(lin, 5.0), duration=2.0, limits=1e-3)
    assert len(held.linear) == len(held.t)
    # The linear model of a loop that is held within limits has no bounds.
    long = fflin.simulate(
        *(robot, fflin.StateFeedback(lin.discretize(5.0), -1e9 * gain.K)),
        **{"x0": displaced(lin, 5.0), "duration": 500.0, "limits": None, "every": 500},
    )
    assert finite(long)


@pytest.mark.parametrize("size", [1e200, 1e60])
def test_a_speed_whose_square_overflows_is_refused_or_a_divergence(size):
    robot = free_body((20.0, 30.0, 40.0))
    with pytest.raises(fflin.InputError, match="initial velocity has an entry of 1e"):
        fflin.simulate(robot, v0=[size, 0, 0, 0, 0, 0], duration=1.0)
    force = np.array([size, 0, 0, 0, 0, 0])
    motion = fflin.simulate(robot, duration=1.0, disturbance=lambda t, q, v: force)
    assert motion.stopped == "diverged at t = 0.01 s"
    assert finite(motion)


def test_the_prediction_is_that_of_the_last_row_too():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, gain.K)
    x0 = lin.x0 + 1e-6 * (displaced(lin) - lin.x0)

    def at_16_steps(t, q, v):
        return 0.155 - t

    motion = fflin.simulate(robot, policy, x0=x0, duration=1.0, every=7, events=[at_16_steps])
    np.testing.assert_allclose(motion.t, [0.0, 0.07, 0.14, 0.16])
    np.testing.assert_allclose(motion.x, motion.linear, atol=1e-9)
    # Between its samples a sampled model says nothing; the continuous one does.
    sampled = fflin.StateFeedback(lin.discretize(0.3), gain.K)
    options = {"x0": x0, "duration": 1.0, "dt": 0.01, "every": 30}
    assert fflin.simulate(robot, sampled, **options).linear is None
    motion = fflin.simulate(robot, sampled, linear=lin, **options)
    np.testing.assert_allclose(motion.x, motion.linear, atol=1e-9)


def test_the_default_step_divides_samples_delay_and_duration():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin.discretize(0.013), gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin), duration=1.0, delay=0.02)
    assert motion.t[-1] == pytest.approx(1.0)
    assert motion.t[1] == pytest.approx(0.001)
    changes = np.flatnonzero(np.diff(motion.u, axis=0).any(axis=1)) + 1
    # At the second sample nothing has acted yet, and so it asks for the same as the first.
    np.testing.assert_array_equal(changes[:3], [20, 46, 59])
    # A fast loop's step is a power of two where nothing else decides on it.
    fast, model, gain = regulated("planar_detumble")
    late = fflin.StateFeedback(model, 0.1 * gain.K)
    motion = fflin.simulate(fast, late, x0=displaced(model), duration=0.1, delay=0.02)
    assert (0.02 / motion.t[1]) % 1.0 == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(fflin.InputError, match=r"duration is 1 s, expected a multiple of the step"):
        fflin.simulate(robot, policy, duration=1.0, dt=0.013)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sample": 0.0}, "sample is 0 s, expected more than 0"),
        ({"sample": "often"}, "sample is 'often', expected a number"),
        ({"duration": 1e-200}, "expected more than 0"),
        ({"dt": 1e-30}, "1e+30 rows"),
        ({"events": None}, "expected a list of functions"),
        ({"events": abs}, "expected a list of functions"),
        ({"events": [lambda t, q, v: None]}, "an event gave None at t = 0.01 s"),
        ({"events": [lambda t, q, v: math.nan]}, "an event gave nan"),
        ({"disturbance": np.zeros(6)}, "disturbance is a ndarray, expected a function"),
        ({"disturbance": lambda t, q, v: "wind"}, "expected real numbers"),
        ({"disturbance": lambda t, q, v: np.full(6, math.nan)}, "finite numbers"),
        ({"method": ["cf4"]}, "no method named"),
        ({"linear": 3}, "linear is a int, expected a fflin.LinearModel"),
    ],
)
def test_bad_input_is_one_line(options, said):
    with pytest.raises(fflin.FflinError) as caught:
        fflin.simulate(free_body((20.0, 30.0, 40.0)), **{"duration": 1.0, **options})
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_that_cannot_predict_is_refused():
    robot, lin, gain = regulated("ets_vii")
    policy = fflin.StateFeedback(lin, gain.K)
    for other in (
        fflin.linearize(fflin.load("canadarm2")),
        fflin.linearize(robot, frame="local"),
        fflin.linearize(robot, moving=True),
    ):
        with pytest.raises(fflin.InputError, match="linearise that robot"):
            fflin.simulate(robot, policy, duration=1.0, linear=other)
    with pytest.raises(fflin.InputError, match="under a StateFeedback alone"):
        fflin.simulate(robot, lambda t, q, v: np.zeros(len(lin.u0)), duration=1.0, linear=lin)


def test_whole_numbers_of_numpy_are_whole_numbers():
    robot = free_body((20.0, 30.0, 40.0))
    assert len(fflin.simulate(robot, duration=1.0, every=np.int64(10)).t) == 11
